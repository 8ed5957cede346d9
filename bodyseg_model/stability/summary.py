"""Accuracy of groups of networks that differ by their seed alone: curves over seeds, mCE, mRR, the worst case; and the
figure of it, a panel for each sweep, a line for each group.

mCE is Hendrycks and Dietterich's mean corruption error ("Benchmarking neural network robustness to common corruptions
and perturbations", 2019) with average per-class accuracy in place of their top-1 accuracy. For one sweep, the
error 1 - accuracy summed over strengths is divided by that of the reference; mCE is the mean over sweeps. mRR is the
mean over sweeps of the mean accuracy over strengths divided by the clean accuracy. Neither counts the clean strength.
"""

import json
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch

from bodyseg_data.core import BadConfig, NotedProgress, silent
from bodyseg_data.drawing import new_chart, plain_axes, save_chart
from bodyseg_data.labels import BACKGROUND, PARTS33
from bodyseg_model.evaluation import MEASURABLE, ConfusionMatrix, GrossErrors, count_pairs, over_seeds, pairs_of
from bodyseg_model.networks import CardWords, Network, Trained, device_of, load_network, predict
from bodyseg_model.stability.scenes import CLEAN, LabelledImage, Scenes, Sweep, SweepPoint

Tree = dict[str, Any]


class _Style(NamedTuple):
    colour: str
    dashes: Any
    marker: str


_STYLES: Final = {
    "none": _Style("#000000", "-", "o"),
    "occ": _Style("#d98e00", (0, (6, 2)), "s"),
    "noise": _Style("#4aa3da", (0, (1.2, 1.6)), "^"),
    "md": _Style("#00785a", (0, (6, 2, 1.2, 2)), "D"),
    "all": _Style("#b8360f", "-", "*"),
}
"""Training variant -> line of its first group, as in the figure of `tools/bench variants`."""

_SPARE: Final = tuple(map(
    _Style,
    ("#8a5aa3", "#6b6b6b", "#9a6a3a", "#c9619a", "#2f4b9a") * 3,
    ((0, (4, 1.5)), (0, (2, 2)), (0, (8, 2)), (0, (3, 1.2, 1, 1.2)), (0, (1, 1))) * 3,
    "vPX<>phdDs1234x",
))  # fmt: skip
"""Lines of further groups; where a colour is repeated, the marker differs."""

_FEW_TIMES: Final = 10  # ratio of the strongest to the weakest from which on strengths are drawn by logarithms
_COLUMNS: Final = 4
_WIDTH: Final = 16.0
_MOST_IN_A_ROW: Final = 6


def draw_stability(figures: Tree, path: Path) -> None:
    """Write a PNG of what `summarise` returned. Bands are one standard deviation over seeds.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    sweeps, groups = figures["sweeps"], figures["groups"]
    columns = min(_COLUMNS, len(sweeps))
    rows = -(-len(sweeps) // columns)
    styles = _styles(groups)
    handles = [_handle(label, group, styles[label]) for label, group in groups.items()]
    longest_in = 1.0 + 0.085 * max(len(handle.get_label()) for handle in handles)  # columns are as wide as this
    in_a_row = max(1, min(_MOST_IN_A_ROW, len(handles), int(_WIDTH / longest_in)))
    legend_rows = -(-len(handles) // in_a_row)
    figure = new_chart(_WIDTH, 0.9 + 0.3 * legend_rows + 3.0 * rows)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axis in axes.flat[len(sweeps) :]:
        axis.set_visible(False)
    for index, (name, sweep) in enumerate(sweeps.items()):
        axis = axes.flat[index]
        _panel(axis, sweep, figures["bound"])
        for order, (label, group) in enumerate(groups.items()):
            _line(axis, sweep["strengths"], group["curves"][name], styles[label], 3 + order)
        if index % columns == 0:
            axis.set_ylabel("average per-class accuracy", fontsize=10)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=in_a_row, fontsize=10.5, handlelength=4.5, frameon=False,
    )  # fmt: skip
    figure.suptitle(
        f"{figures['images']} test images at every strength; one thing changes in each panel, all else is clean. "
        f"Lines: mean over seeds, bands: ± 1 standard deviation; dashed grey: {100 * figures['bound']:.0f} %",
        x=0.005,
        ha="left",
        fontsize=11,
    )
    save_chart(figure, path, dpi=100)


def _styles(groups: Tree) -> dict[str, _Style]:
    styles: dict[str, _Style] = {}
    spare = cycle(_SPARE)
    for label, group in groups.items():
        style = _STYLES.get(group["variant"])
        styles[label] = next(spare) if style is None or style in styles.values() else style
    return styles


def _panel(axis: Any, sweep: Tree, bound: float) -> None:
    strengths = sweep["strengths"]
    axis.axhline(bound, color="#8a8a8a", linewidth=0.9, linestyle=(0, (6, 2)), zorder=1)
    axis.set_ylim(0, 1)
    if min(strengths) > 0 and max(strengths) > _FEW_TIMES * min(strengths):
        axis.set_xscale("log")
    axis.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=9)
    axis.minorticks_off()
    if strengths[-1] < strengths[0]:
        axis.invert_xaxis()  # severity rises to the right
    axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.set_xlabel(sweep["axis"], fontsize=9.5)
    # In two lines: longer titles would run into the next panel's.
    axis.set_title(sweep["title"] + ("" if sweep["counts"] else "\n(not in mCE, mRR)"), loc="left", fontsize=10.5)
    plain_axes(axis)


def _line(axis: Any, strengths: list[float], curve: Tree, style: _Style, order: int) -> None:
    if None not in curve["sd"]:
        edges = [[mean + sign * sd for mean, sd in zip(curve["mean"], curve["sd"], strict=True)] for sign in (-1, 1)]
        axis.fill_between(strengths, *edges, color=style.colour, alpha=0.15, linewidth=0)
    axis.plot(strengths, curve["mean"], zorder=order, **_drawn(style))


def _drawn(style: _Style) -> Tree:
    return {
        "color": style.colour,
        "linestyle": style.dashes,
        "linewidth": 1.6,
        "marker": style.marker,
        "markersize": 9 if style.marker == "*" else 5,
        "markeredgecolor": "white",
        "markeredgewidth": 0.5,
    }


def _handle(label: str, group: Tree, style: _Style) -> Any:
    from matplotlib.lines import Line2D

    count = len(group["seeds"])
    return Line2D([], [], label=f"{label}: {count} seed{'' if count == 1 else 's'}", **_drawn(style))


FEWEST_SEEDS: Final = 3
"""With fewer seeds a standard deviation says little."""

_AS_DECLARED: Final = ("network", "settings", "variant", "recipe", "pretrained", "data", "validation")
_ALIKE: Final = (*_AS_DECLARED, "earlier_steps", "last_step")


@dataclass(frozen=True)
class Run:
    """A trained network. path: a run's folder or a .safetensors file. name: unique among those loaded together."""

    name: str
    path: Path
    trained: Trained = field(repr=False)

    @property
    def seed(self) -> Any:
        """Seed of the training, from the network's card; None if the card has none."""
        return self.trained.card.get("seed")


@dataclass(frozen=True)
class Group:
    """Networks that differ by their seed alone, in the order given. label: unique among groups."""

    label: str
    runs: tuple[Run, ...]

    @property
    def few_seeds(self) -> bool:
        """True for fewer seeds than `FEWEST_SEEDS`."""
        return len({run.seed for run in self.runs}) < FEWEST_SEEDS

    def to_json(self) -> dict[str, Any]:
        """Network, settings and variant that the runs share, and the runs' names and seeds."""
        card = self.runs[0].trained.card
        return {
            **{name: card.get(name) for name in ("network", "settings", "variant")},
            "runs": [run.name for run in self.runs],
            "seeds": [run.seed for run in self.runs],
            "few_seeds": self.few_seeds,
        }


def load_runs(paths: Sequence[Path]) -> list[Run]:
    """Load the networks of runs' folders or .safetensors files, each once; raises BadConfig as `load_network`,
    and for a network of other classes than the 33 parts.

    A run is named after its folder, with as many parent folders as are needed to tell it from the others.
    """
    given = {path.resolve(): path for path in paths}
    plain = {full: full.with_suffix("") if full.suffix == ".safetensors" else full for full in given}
    every = [(full if plain[full] in given else plain[full]).parts for full in given]
    runs = []
    for parts, path in zip(every, given.values(), strict=True):
        depth = 1
        while depth < len(parts) and sum(parts[-depth:] == other[-depth:] for other in every) > 1:
            depth += 1
        trained = load_network(path)
        if trained.label_map != PARTS33:
            raise BadConfig(
                f"{path}: stability is measured on the 33 parts, which a network with labels "
                f"{trained.label_map.name!r} does not predict"
            )
        runs.append(Run("/".join(parts[-depth:]), path, trained))
    return runs


def group(runs: Sequence[Run]) -> list[Group]:
    """Group runs that differ by seed alone, in the order of first runs. Raises BadConfig for weights given twice."""
    alike: dict[str, list[Run]] = {}
    first = dict[str | None, Run]()
    for run in runs:
        digest = run.trained.card.get(CardWords.WEIGHTS_SHA256)
        if digest is not None and first.setdefault(digest, run) is not run:
            raise BadConfig(f"a network counts once: {first[digest].path} and {run.path} have the same weights")
        alike.setdefault(_identity(run.trained.card), []).append(run)
    labels = _labels([members[0] for members in alike.values()])
    return [Group(label, tuple(members)) for label, members in zip(labels, alike.values(), strict=True)]


def group_of(groups: Sequence[Group], paths: Sequence[Path]) -> Group | None:
    """Find the one group that contains `paths`; None for no paths. Raises BadConfig if they are in several."""
    given = {path.resolve() for path in paths}
    found = [each for each in groups if given & {run.path.resolve() for run in each.runs}]
    if len(found) > 1:
        raise BadConfig(
            "networks to compare with must differ by their seed alone, found "
            f"{', '.join(each.runs[0].name for each in found)}"
        )
    return found[0] if found else None


def _identity(card: dict[str, Any]) -> str:
    """All on a card that identifies a training, as JSON, without names of files and seeds, its own and each set's."""
    text = json.dumps([card.get(name) for name in _ALIKE])
    return json.dumps(json.loads(text, object_hook=lambda tree: tree | {"seed": None, "file": None}), sort_keys=True)


def _labels(runs: Sequence[Run]) -> list[str]:
    """Unique labels of groups: the first run's name without "-SEED", or with its network added, or the full name."""
    short = [run.name.removesuffix(f"-{run.seed}") for run in runs]
    longer = [f"{name} ({run.trained.card['network']})" for name, run in zip(short, runs, strict=True)]
    for names in (short, longer):
        if max(Counter(names).values(), default=1) == 1:
            return names
    return [run.name for run in runs]


class Score(NamedTuple):
    """Average per-class accuracy and gross errors of one network under one condition."""

    accuracy: float
    gross_errors: GrossErrors


Found = dict[str, dict[SweepPoint, Score]]
"""Run's name -> condition -> score."""


def score(network: Network, images: Sequence[LabelledImage]) -> Score:
    """Score a network in evaluation mode, by one confusion matrix over all images; without SciPy no gross errors.

    Images, which may differ in size, are predicted one by one. NaN if nothing was measured in any of them.
    """
    matrix, gross = ConfusionMatrix(), GrossErrors()
    device = device_of(network)
    for image in images:
        prediction = predict(network, torch.from_numpy(image.range_m)[None, None].to(device))
        predicted = prediction.labels[0].cpu().numpy().ravel()[image.pixels]
        counts = count_pairs(pairs_of(image.truth, predicted))
        matrix.counts += counts
        if MEASURABLE:
            wrong = (image.truth != BACKGROUND) & (image.truth != predicted)
            gross.add(image.surface.distances(image.places[wrong], predicted[wrong]), int(counts.trace()))
    return Score(matrix.average_per_class_accuracy(), gross)


def evaluate_conditions(
    runs: Sequence[Run], conditions: Sequence[SweepPoint], scenes: Scenes, progress: NotedProgress = silent
) -> Found:
    """Score every network under every condition.

    progress: called with images done, images in all, and the condition's name. Raises BadConfig, before any is
    measured, for a condition that the scenes cannot show.
    """
    for condition in conditions:
        scenes.check(condition)
    found: Found = {run.name: {} for run in runs}
    done, total = 0, len(runs) * len(conditions) * len(scenes)
    for condition in conditions:  # the outer loop, so that images are made once
        images = scenes.labelled_images(condition)
        for run in runs:
            found[run.name][condition] = score(run.trained.network, images)
            done += len(scenes)
            progress(done, total, condition.name)
    return found


BOUND: Final = 0.6


def summarise(groups: Sequence[Group], sweeps: Mapping[str, Sweep], found: Found, reference: Group | None) -> Tree:
    """Build the part of stability.json that is about images; plain JSON. found: has every condition of the sweeps."""
    conditions = {name: sweep.conditions(name) for name, sweep in sweeps.items()}
    curves = {
        group.label: {
            name: [[found[run.name][condition].accuracy for condition in row] for run in group.runs]
            for name, row in conditions.items()
        }
        for group in groups
    }
    means = None if reference is None else {name: _mean(rows) for name, rows in curves[reference.label].items()}
    return {
        "bound": BOUND,
        "reference": None if reference is None else reference.label,
        "sweeps": {name: {**asdict(sweep), "strengths": list(sweep.strengths)} for name, sweep in sweeps.items()},
        "groups": {
            group.label: {
                **group.to_json(),
                "clean": _clean(group, conditions, found),
                **_scores(sweeps, curves[group.label], means),
                "gross_errors": {name: _gross_errors(group, row, found) for name, row in conditions.items()},
            }
            for group in groups
        },
    }


def corruption_error(curve: Sequence[float], reference: Sequence[float]) -> float | None:
    """Summed errors of one sweep over the reference's, both without the clean one; None if the reference has none."""
    errors = sum(1 - accuracy for accuracy in reference[1:])
    return sum(1 - accuracy for accuracy in curve[1:]) / errors if errors else None


def relative_robustness(curve: Sequence[float]) -> float | None:
    """Mean accuracy of one sweep without the clean one, over the clean accuracy; None if that is 0."""
    return sum(curve[1:]) / ((len(curve) - 1) * curve[0]) if curve[0] else None


def falls_below(strengths: Sequence[float], curve: Sequence[float]) -> float | None:
    """Strength at which accuracy first falls below `BOUND`, interpolated linearly; None if it never does.

    It is the first strength if accuracy is below the bound there already.
    """
    if curve[0] < BOUND:
        return strengths[0]
    for (low, before), (high, after) in pairwise(zip(strengths, curve, strict=True)):
        if after < BOUND:
            return round(low + (before - BOUND) / (before - after) * (high - low), 4)
    return None


def _mean(rows: Sequence[Sequence[float]]) -> list[float]:
    """Mean over seeds at each strength."""
    return [statistics.mean(values) for values in zip(*rows, strict=True)]


def _gross_errors(group: Group, row: Sequence[SweepPoint], found: Found) -> Tree | None:
    """Each of the gross errors' scores of one sweep, as a curve is; None if they were not counted everywhere."""
    rows = [[found[run.name][condition].gross_errors.to_json() for condition in row] for run in group.runs]
    counted = [[each for each in scores if each is not None] for scores in rows]
    if counted != rows:
        return None
    return {name: _curve([[each[name] for each in scores] for scores in counted]) for name in counted[0][0]}


def _clean(group: Group, conditions: Mapping[str, Sequence[SweepPoint]], found: Found) -> Tree:
    """Accuracy on the clean stored and the clean rendered images, as far as the sweeps have them."""
    needed = {row[0] for row in conditions.values()}
    return {
        origin: over_seeds([found[run.name][clean].accuracy for run in group.runs])
        for origin, clean in CLEAN.items()
        if clean in needed
    }


def _scores(
    sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]], reference: Mapping[str, list[float]] | None
) -> Tree:
    """Scores of one group from its accuracies, sweep -> seed -> strength."""
    counted = [name for name, sweep in sweeps.items() if sweep.counts]
    robustness = {name: [relative_robustness(row) for row in curves[name]] for name in counted}
    errors = (
        None
        if reference is None
        else {name: [corruption_error(row, reference[name]) for row in curves[name]] for name in counted}
    )
    return {
        "curves": {name: _curve(rows) for name, rows in curves.items()},
        "falls_below_bound_at": {
            name: {
                "mean": falls_below(sweep.strengths, _mean(curves[name])),
                "seeds": [falls_below(sweep.strengths, row) for row in curves[name]],
            }
            for name, sweep in sweeps.items()
        },
        "worst": _worst(sweeps, curves),
        "mrr": _over_sweeps(robustness),
        "mce": None if errors is None else _over_sweeps(errors),
    }


def _curve(rows: Sequence[Sequence[float]]) -> Tree:
    points = [over_seeds(values) for values in zip(*rows, strict=True)]
    seeds = [[round(value, 5) for value in row] for row in rows]
    return {name: [point[name] for point in points] for name in ("mean", "sd")} | {"seeds": seeds}


def _over_sweeps(values: Mapping[str, Sequence[float | None]]) -> Tree | None:
    """Mean over sweeps for every seed, and each sweep's mean over seeds; None if any number is missing."""
    complete = {name: [value for value in row if value is not None] for name, row in values.items()}
    if not values or any(len(complete[name]) < len(row) for name, row in values.items()):
        return None
    by_sweep = {name: round(statistics.mean(row), 5) for name, row in complete.items()}
    return over_seeds([statistics.mean(row) for row in zip(*complete.values(), strict=True)]) | {"sweeps": by_sweep}


def _worst(sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]]) -> Tree:
    """The sweep and strength, clean ones aside, at which the mean over seeds is lowest."""
    lowest, name, index = min(
        (accuracy, name, index) for name, rows in curves.items() for index, accuracy in enumerate(_mean(rows)) if index
    )
    return {"sweep": name, "strength": sweeps[name].strengths[index], "accuracy": round(lowest, 5)}
