"""Charts of an evaluation, drawn from its JSON, and a picture of single test images."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.drawing import (
    EMPTY,
    FAINT,
    INK,
    PAPER,
    colour_range,
    colour_shares,
    draw_legend,
    fitted,
    font,
    new_chart,
    plain_axes,
    save_chart,
)
from bodyseg_data.labels import BACKGROUND, PARTS33, LabelMap, colour_labels, label_map_from_json
from bodyseg_data.samples import box_of
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.evaluation.reports import PAPERS_THRESHOLD, subset_order
from bodyseg_model.evaluation.scores import KINDS, ConfusionMatrix, kinds_of

Tree = dict[str, Any]

_DARK: Final = "#1f4fa8"
_PALE: Final = "#a9c4ea"
_LONGEST: Final = 30  # letters of a name
_LEAST_SHARE: Final = 0.001  # of pixels, for a bin's accuracy to say anything


def draw_figures(figures: Tree, folder: Path) -> list[Path]:
    """Write the charts that `figures`, the result of `report`, has numbers for, into `folder`; returns the files.

    Raises MissingLibrary without matplotlib, BadConfig if a file cannot be written.
    """
    charts: dict[str, Callable[[Tree], Any]] = {"parts": draw_parts, "confusion": draw_confusion}
    if "reliability" in figures:
        charts["confidence"] = draw_confidence
    for name, draw in charts.items():
        save_chart(draw(figures), folder / f"{name}.png", dpi=110)
    return [folder / f"{name}.png" for name in charts]


def draw_parts(figures: Tree) -> Any:
    """Average per-class accuracy of the set and its subsets, and accuracy of each class: the paper's Fig. 6."""
    groups = {"all": figures} | figures["subsets"] | {"all": figures}  # "all" of the subsets is another
    parts = figures["classes"]
    figure = new_chart(9.5, 3.2 + 0.27 * (len(groups) + len(parts)))
    upper, lower = figure.subplots(2, 1, height_ratios=(len(groups) + 0.6, len(parts) + 0.6), sharex=True)
    _bars(
        upper,
        [f"{_shown(name)}  (images: {format(its['images'], ',').replace(',', ' ')})" for name, its in groups.items()],
        [group["average_per_class_accuracy"] for group in groups.values()],
        [(group["over_images"]["mean"], group["over_images"]["sd"]) for group in groups.values()],
    )
    upper.set_title("Average per-class accuracy: all images, and by subset", loc="left", fontsize=11)
    _bars(
        lower,
        [f"{_shown(part['name'])}  {part['label']:>2}" for part in parts],
        [part["accuracy"] for part in parts],
        [(part["mean_over_images"], part["sd_over_images"]) for part in parts],
    )
    lower.axvline(figures["average_per_class_accuracy"] or 0, color="black", linewidth=0.9, linestyle="--", zorder=4)
    lower.set_title("Accuracy of each class over all images; dashed: their average", loc="left", fontsize=11)
    lower.set_xlabel(
        "bar and number: right pixels among all of the class's pixels;\n"
        "dot and line: mean and standard deviation over images, each image counting once",
        fontsize=9,
    )
    return figure


def _shown(name: str) -> str:
    """A name as charts have room for it; what is between dollar signs would be a formula."""
    return (name if len(name) <= _LONGEST else f"{name[: _LONGEST - 3]}...").replace("$", r"\$")


def _bars(axis: Any, names: list[str], values: list[float | None], spreads: list[tuple[Any, Any]]) -> None:
    positions = np.arange(len(names))
    axis.barh(positions, [value or 0 for value in values], color=_PALE, edgecolor=_DARK, linewidth=0.6, height=0.74)
    for y, value in zip(positions, values, strict=True):
        axis.text(1.015, y, "not shown" if value is None else f"{100 * value:.1f} %", va="center", fontsize=9)
    known = np.array([(y, mean, spread or 0) for y, (mean, spread) in enumerate(spreads) if mean is not None])
    places, means, around = known.reshape(-1, 3).T
    axis.hlines(places, np.maximum(means - around, 0), np.minimum(means + around, 1), color="black", linewidth=1.1)
    axis.plot(means, places, "o", color="black", markersize=3.6)
    axis.set_yticks(positions, names, fontsize=9)
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.set_xlim(0, 1)
    axis.set_xticks(np.arange(0, 1.01, 0.1), [f"{tick} %" for tick in range(0, 101, 10)], fontsize=9)
    axis.tick_params(axis="y", length=0)
    axis.tick_params(axis="x", labelbottom=True)
    plain_axes(axis, "x")


def draw_confusion(figures: Tree) -> Any:
    """Confusion matrix: each row shows the predicted parts of one true part's pixels."""
    from matplotlib.colors import PowerNorm
    from matplotlib.lines import Line2D

    counts = np.array(figures["confusion"], np.float64)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    label_map = label_map_from_json(figures["labels"], "labels of the scores") if "labels" in figures else PARTS33
    side = 5.0 + 0.2 * len(label_map)
    figure = new_chart(side + 1, side)
    axis = figure.subplots()
    drawn = axis.imshow(shares, cmap="Greys", norm=PowerNorm(0.45, 0, 1))
    for row, column in np.argwhere(shares >= 0.01):
        colour = "white" if shares[row, column] > 0.3 else "black"
        axis.text(column, row, f"{100 * shares[row, column]:.0f}", ha="center", va="center", fontsize=7, color=colour)
    sides: Tree = {"color": _DARK, "linewidth": 1.4}
    faces: Tree = {"color": "#b06f00", "linewidth": 1.6, "linestyle": (0, (4, 2))}
    kinds = kinds_of(label_map)
    _outline(axis, np.isin(kinds, [KINDS.index("front/back"), KINDS.index("both")]), faces)
    _outline(axis, np.isin(kinds, KINDS.index("left/right")), sides)
    names = list(enumerate(map(_shown, label_map.names)))
    axis.set_xticks(range(len(names)), [f"{label}  {name}" for label, name in names], fontsize=8, rotation=90)
    axis.set_yticks(range(len(names)), [f"{name}  {label}" for label, name in names], fontsize=8)
    word = "part" if label_map == PARTS33 else "class"
    axis.set_xlabel(f"predicted {word}", fontsize=10)
    axis.set_ylabel(f"true {word}", fontsize=10)
    figure.suptitle(f"Prediction for the pixels of each true {word}, per cent (1 and more)", fontsize=12)
    bar = figure.colorbar(drawn, ax=axis, shrink=0.6, pad=0.01, ticks=[0, 0.01, 0.05, 0.1, 0.25, 0.5, 1])
    bar.ax.set_yticklabels(["0", "1 %", "5 %", "10 %", "25 %", "50 %", "100 %"], fontsize=9)
    swaps = figures["swaps"]
    handles = []
    if "left_right" in swaps:
        handles.append(Line2D([], [], label=f"left for right: {_percent(swaps['left_right'])} of all pixels", **sides))
    if "front_back" in swaps:
        both = f", and left for right as well: {_percent(swaps['both'])}" if "both" in swaps else ""
        handles.append(Line2D([], [], label=f"front for back: {_percent(swaps['front_back'])}{both}", **faces))
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=10, frameon=False)
    return figure


def _outline(axis: Any, mask: NDArray[np.bool_], style: Tree) -> None:
    """Draw a line around each region of cells in `mask`."""
    from matplotlib.collections import LineCollection

    padded = np.pad(mask, 1)
    level, upright = padded[1:, 1:-1] != padded[:-1, 1:-1], padded[1:-1, 1:] != padded[1:-1, :-1]
    lines = [[(column - 0.5, row - 0.5), (column + 0.5, row - 0.5)] for row, column in np.argwhere(level)]
    lines += [[(column - 0.5, row - 0.5), (column - 0.5, row + 0.5)] for row, column in np.argwhere(upright)]
    axis.add_collection(LineCollection(lines, zorder=4, capstyle="projecting", **style))


def draw_confidence(figures: Tree) -> Any:
    """Risk against coverage, and the reliability diagram of confidences."""
    figure = new_chart(12, 5.6)
    left, right = figure.subplots(1, 2)
    _risk_coverage(left, figures)
    _reliability(right, figures)
    return figure


def _risk_coverage(axis: Any, figures: Tree) -> None:
    curve, kept = figures["risk_coverage"], figures["confidence"]["above_70_percent"]
    risk = np.array(curve["risk"], np.float64)  # NaN for null
    axis.plot(curve["coverage"], risk, color=_DARK, linewidth=2)
    axis.fill_between(curve["coverage"], risk, color=_PALE, alpha=0.45, linewidth=0)
    wrong = 1 - (figures["pixel_accuracy"] or 0)
    top = max(1.35 * wrong, 0.01)
    if kept["pixel_accuracy"] is not None:
        point = kept["share_of_pixels"], 1 - kept["pixel_accuracy"]
        axis.plot(*point, "o", color="black", markersize=8)
        axis.annotate(
            f"confidence above {100 * PAPERS_THRESHOLD:.0f} %:\n"
            f"{_percent(1 - point[0])} of pixels dropped,\n{_percent(point[1])} of the rest wrong\n"
            f"average per-class accuracy\n{_percent(figures['average_per_class_accuracy'])} → "
            f"{_percent(kept['average_per_class_accuracy'])}",
            point,
            (0.05, 0.62),
            textcoords="axes fraction",
            fontsize=10,
            arrowprops={"arrowstyle": "-", "color": "black", "linewidth": 0.8, "shrinkB": 5},
        )
    axis.set_xlim(0, 1)
    axis.set_ylim(0, top)
    axis.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.3g} %")
    axis.set_xlabel("coverage: pixels kept, most confident first", fontsize=10)
    axis.set_ylabel("risk: kept pixels that are wrong", fontsize=10)
    axis.set_title(f"Risk and coverage: area {figures['confidence']['aurc']}", loc="left", fontsize=11)
    plain_axes(axis, "both")


def _reliability(axis: Any, figures: Tree) -> None:
    pixels = max(figures["pixels"], 1)
    rows = [row for row in figures["reliability"] if row["pixels"] >= _LEAST_SHARE * pixels]
    axis.plot([0, 1], [0, 1], color="black", linewidth=0.9, linestyle="--", zorder=2)
    for row in rows:
        width = row["up_to"] - row["confidence_above"]
        axis.bar(row["confidence_above"] + width / 2, row["pixels"] / pixels, 0.86 * width, color="#dcdcdc", zorder=1)
        axis.plot([row["confidence"]] * 2, [row["confidence"], row["accuracy"]], color=_DARK, linewidth=1.2, zorder=3)
    confidences, accuracies = ([row[name] for row in rows] for name in ("confidence", "accuracy"))
    label = "accuracy of the pixels in the bin"
    axis.plot(confidences, accuracies, "o-", color=_DARK, linewidth=1.6, markersize=6, zorder=4, label=label)
    axis.bar(0, 0, color="#dcdcdc", label="share of all pixels")
    axis.plot([], [], color="black", linewidth=0.9, linestyle="--", label="perfect calibration")
    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1)
    for which in (axis.xaxis, axis.yaxis):
        which.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.set_xlabel("confidence, in 15 bins; those with a thousandth of the pixels or more", fontsize=10)
    axis.set_title(
        f"Reliability: expected calibration error {_percent(figures['confidence']['ece'])}", loc="left", fontsize=11
    )
    axis.legend(loc="upper left", fontsize=9.5, framealpha=1, edgecolor="none")
    plain_axes(axis, "both")


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


_THRESHOLD: Final = f"{100 * PAPERS_THRESHOLD:.0f} %"
_HEADS: Final = ("range", "truth", "prediction", "mistakes", "confidence", f"above {_THRESHOLD} only")

_DROPPED: Final = (120, 122, 128)
_RIGHT, _WRONG, _SWAPPED = (220, 226, 236), (232, 134, 46), (148, 62, 190)
_KIND_COLOURS: Final = {"right": _RIGHT, "other": _WRONG}
"""Any other kind is a swap. Light, medium and dark, so that they differ in grey, too."""

# Low to high confidence: dark to light as well as blue to yellow.
_RAMP: Final = np.array([[0, 34, 78], [66, 78, 108], [124, 123, 120], [189, 175, 110], [254, 232, 56]])

_HEIGHT: Final = 340
_WIDTH: Final = 190
_LEAST_WIDTH: Final = 150
_TOP: Final = 30
_GAP: Final = 8
_CAPTION: Final = 22
_BODY_MARGIN: Final = 6


class SamplePicture:
    """Collects every subset's first image and the image of lowest accuracy. label_map: the classes of the labels."""

    def __init__(self, label_map: LabelMap = PARTS33) -> None:
        self._label_map = label_map
        self._first: dict[str, tuple[float, PredictedImage]] = {}
        self._worst: tuple[float, PredictedImage] | None = None

    def watch(self, image: PredictedImage, accuracy: float) -> None:
        """Consider one image for the figure; empty ones are ignored."""
        if np.isnan(accuracy):
            return
        if image.subset not in self._first:
            self._first[image.subset] = accuracy, _cropped(image)
        if self._worst is None or accuracy < self._worst[0]:
            self._worst = accuracy, _cropped(image)

    def draw(self) -> Image.Image | None:
        """Draw the figure; None if every image was empty."""
        if self._worst is None:
            return None
        groups = sorted(self._first, key=subset_order)
        shown = [(f"first of {name}", *self._first[name]) for name in groups]
        shown.append(("worst of all", *self._worst))
        lines = [[fitted(panel, _WIDTH, _HEIGHT) for panel in _panels(image, self._label_map)] for _, _, image in shown]
        widths = [max(_LEAST_WIDTH, *(line[column].width for line in lines)) for column in range(len(_HEADS))]
        width = sum(widths) + _GAP * (len(_HEADS) + 1)
        legend = _legend(width - 2 * _GAP, self._label_map)
        heights = [_CAPTION + line[0].height + _GAP for line in lines]
        picture = Image.new("RGB", (width, _TOP + sum(heights) + legend.height + 2 * _GAP), PAPER)
        pen = ImageDraw.Draw(picture)
        lefts = [_GAP + sum(widths[:column]) + _GAP * column for column in range(len(_HEADS))]
        for left, head in zip(lefts, _HEADS, strict=True):
            pen.text((left, 7), head, INK, font=font(15))
        top = _TOP
        for (which, accuracy, image), line, height in zip(shown, lines, heights, strict=True):
            pen.text((_GAP, top + 3), f"{which}: {_caption(accuracy, image, self._label_map)}", FAINT, font=font(13))
            for left, panel in zip(lefts, line, strict=True):
                picture.paste(panel, (left, top + _CAPTION))
            top += height
        picture.paste(legend, (_GAP, top + _GAP))
        return picture


def _cropped(image: PredictedImage) -> PredictedImage:
    """A copy of an image, cropped to the body."""
    box = box_of(image.labels != BACKGROUND, _BODY_MARGIN) or np.s_[:, :]
    arrays = ("range_m", "labels", "predicted", "confidence")
    return image._replace(**{name: getattr(image, name)[box].copy() for name in arrays})


def _caption(accuracy: float, image: PredictedImage, label_map: LabelMap) -> str:
    confident = ConfusionMatrix(len(label_map))
    confident.add(np.where(image.confidence > PAPERS_THRESHOLD, image.labels, np.uint8(BACKGROUND)), image.predicted)
    share = confident.pixels / np.count_nonzero(image.labels != BACKGROUND)
    caption = f"{image.key}. Average per-class accuracy {100 * accuracy:.1f} %"
    if not confident.pixels:
        return f"{caption}; no pixel is above {_THRESHOLD}"
    better = 100 * confident.average_per_class_accuracy()
    return f"{caption}; {better:.1f} % among the {100 * share:.0f} % of pixels above {_THRESHOLD}"


def _panels(image: PredictedImage, label_map: LabelMap) -> list[NDArray[np.uint8]]:
    body = image.labels != BACKGROUND
    # Noise has long tails: the ramp covers 98 % of the pixels.
    near, far = (float(edge) for edge in np.percentile(image.range_m[body], (1, 99)))
    kinds = np.zeros(body.shape, np.uint8)
    kinds[body] = kinds_of(label_map)[image.labels[body], image.predicted[body]]
    mistakes = np.array([_KIND_COLOURS.get(kind, _SWAPPED) for kind in KINDS], np.uint8)[kinds]
    mistakes[~body] = EMPTY
    confidence = colour_shares(image.confidence, _RAMP)
    confidence[~body] = EMPTY
    confident = colour_labels(image.predicted, EMPTY, label_map.colours)
    confident[body & (image.confidence <= PAPERS_THRESHOLD)] = _DROPPED
    return [
        colour_range(image.range_m, near, far),
        colour_labels(image.labels, EMPTY, label_map.colours),
        colour_labels(image.predicted, EMPTY, label_map.colours),
        mistakes,
        confidence,
        confident,
    ]


def _legend(width: int, label_map: LabelMap) -> Image.Image:
    """The colours of mistakes and confidence, and the classes."""
    parts = draw_legend(width, label_map)
    legend = Image.new("RGB", (width, parts.height + 34), PAPER)
    legend.paste(parts, (0, 34))
    pen = ImageDraw.Draw(legend)
    left = 0
    for colour, name in (
        (_RIGHT, "right"),
        (_WRONG, "wrong"),
        (_SWAPPED, "left for right, or front for back"),
        (_DROPPED, "dropped"),
        (EMPTY, "nothing measured"),
    ):
        pen.rectangle((left, 7, left + 15, 22), colour, FAINT)
        pen.text((left + 22, 15), name, INK, font=font(13), anchor="lm")
        left += 22 + int(font(13).getlength(name)) + 22
    ramp = colour_shares(np.tile(np.linspace(0, 1, 150, dtype=np.float32), (15, 1)), _RAMP)
    legend.paste(Image.fromarray(ramp), (left, 7))
    pen.text((left + 158, 15), "confidence 0 to 100 %", INK, font=font(13), anchor="lm")
    return legend
