"""Adds up what `bench occlusion` measures: errors by scene, time, bytes, and where the worst errors are."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.occlusion.baselines import DEFAULT, METHODS, NEAREST, Images, Method
from benches.data.occlusion.stored import MASK_IMAGE, Storage, StoredImage, exact_masks
from benches.data.occlusion.views import CONTACT_M, GRAZING_DEG, GROUPS, ORDINARY, ExactView, Group, grown
from benches.measuring import median_time
from bodyseg_data.artifacts import ShadowTest

WORST_CROP: Final = 100, 80
"""Rows and columns of the window with the most errors that is looked for in every scene."""

_MASKS: Final[dict[str, Callable[[ExactView], NDArray[np.bool_]]]] = {
    f"light at {GRAZING_DEG:g} to 90 degrees": lambda view: view.grazing,
    f"contact shadows, under {CONTACT_M * 1000:g} mm": lambda view: view.contact,
    "hands, wrists, ankles, toes": lambda view: view.thin,
    "edges of their shadows": lambda view: view.thin_shadow,
}
"""Scenes that are some pixels of all views with the rig's own baseline."""

SCENES: Final = (*(group.name for group in GROUPS), *_MASKS)
_ROUNDS: Final = 4
_RUNS: Final = 4

Mask = Callable[[ShadowTest, Images], NDArray[np.bool_]]
CompiledMask = Callable[[ShadowTest, Images, NDArray[np.int32]], NDArray[np.bool_]]


class Foreground:
    """A view's foreground inside the projector's frame, and which of its pixels belong to which scene.

    pixels: int [N], flat. exact: bool [N], whether lit. scenes: name -> bool [N].
    """

    def __init__(self, group: Group, view: ExactView) -> None:
        self.group, self.view = group, view
        self.pixels = np.flatnonzero(view.inside)
        self.exact = view.lit.ravel()[self.pixels]
        self.scenes = {group.name: np.ones(len(self.pixels), np.bool_)}
        if group.baseline_m == GROUPS[0].baseline_m:
            self.scenes |= {name: mask(view).ravel()[self.pixels] for name, mask in _MASKS.items()}


class Tally:
    """One method's errors, time and bytes."""

    def __init__(self, method: Method) -> None:
        self.method = method
        self._errors = {scene: np.zeros(3, np.int64) for scene in SCENES}  # wrongly lit, wrongly dark, all pixels
        self._worst, self._differing = 0.0, 0
        self._times: list[tuple[float, float]] = []
        self._bytes: list[int] = []

    def add(self, foreground: Foreground, storage: Storage) -> None:
        """Count errors of a view."""
        answer = self._lit(storage, storage.whole(self.method)).ravel()[foreground.pixels]
        false_lit, false_dark = answer & ~foreground.exact, ~answer & foreground.exact
        for scene, mask in foreground.scenes.items():
            counts = [np.count_nonzero(kind & mask) for kind in (false_lit, false_dark)]
            self._errors[scene] += [*counts, np.count_nonzero(mask)]
            if scene == ORDINARY:
                self._worst = max(self._worst, sum(counts) / max(len(foreground.pixels), 1))

    def note_cost(self, storage: Storage, test_s: float) -> None:
        """Note the bytes and times of a view, and whether what is stored gives the mask of the whole image."""
        stored = storage.of(self.method)
        size, decode_s = stored.cost
        masks = [self._lit(storage, image) for image in (stored, storage.whole(self.method))]
        self._differing += int(np.count_nonzero(masks[0] != masks[1]))
        self._times.append((test_s, decode_s))
        self._bytes.append(size)

    def seconds(self, storage: Storage) -> float:
        """Processor time of the test in one view, the median of four runs."""
        return median_time(lambda: self._lit(storage, storage.of(self.method)), _RUNS)[0]

    def row(self, facing_bytes: int) -> dict[str, Any]:
        """The method's row of the JSON."""
        method = self.method
        false_lit, false_dark, pixels = (int(count) for count in self._errors[ORDINARY])
        tests, decodings = zip(*self._times, strict=True)
        return {
            "name": method.family,
            "family": method.family,
            "bias": method.bias_mm,
            "projector_scale": method.projector_scale,
            "facing_bit": method.facing_bit,
            "stored": method.stored,
            "form": "numpy",
            "wrong_pixels": share(false_lit + false_dark, pixels),
            "us_per_view": microseconds([test + decode for test, decode in self._times]),
            "test_us": microseconds(tests),
            "decode_us": microseconds(decodings),
            "bytes": round(statistics.mean(self._bytes)) + (facing_bytes if method.facing_bit else 0),
            "false_lit": share(false_lit, pixels),
            "false_shadow": share(false_dark, pixels),
            "worst_view": round(float(self._worst), 6),
            "differing_pixels": self._differing,
            "scenes": {name: share(int(counts[:2].sum()), int(counts[2])) for name, counts in self._errors.items()},
        }

    def _lit(self, storage: Storage, stored: StoredImage) -> NDArray[np.bool_]:
        images = storage.view.range, stored.image, storage.view.facing
        return self.method.lit(storage.tests[self.method.projector_scale], images)


def time_all(tallies: list[Tally], storage: Storage, start: int) -> None:
    """Time all methods on one view in turn, a few rounds, each round beginning with another.

    Each is run four times at a time, so that it finds its own data in the processor's caches and not its neighbour's.
    """
    rounds: list[list[float]] = [[] for _ in tallies]
    for turn in range(_ROUNDS):
        for offset in range(len(tallies)):
            index = (offset + start + turn * len(tallies) // _ROUNDS) % len(tallies)
            rounds[index].append(tallies[index].seconds(storage))
    for tally, seconds in zip(tallies, rounds, strict=True):
        tally.note_cost(storage, statistics.median(seconds))


class Compiled:
    """The default and its closest baseline, compiled, at several sizes of the projector's image; none without numba."""

    def __init__(self) -> None:
        self._forms: dict[Method, CompiledMask] = {}
        if find_spec("numba") is not None:
            from benches.data.occlusion import compiled_default, compiled_nearest

            forms: dict[tuple[str, float], CompiledMask] = {
                (DEFAULT.family, DEFAULT.bias_mm): lambda test, images, texels: compiled_default.lit(
                    test, *images, texels
                ),
                (NEAREST.family, NEAREST.bias_mm): partial(compiled_nearest.lit, bias_mm=NEAREST.bias_mm),
            }
            for method in METHODS:
                form = forms.get((method.family, method.bias_mm))
                if form is not None and method.facing_bit:
                    self._forms[method] = form
        self._times: dict[Method, list[tuple[float, float, float]]] = {method: [] for method in self._forms}
        self._differing = dict.fromkeys(self._forms, 0)

    def add(self, storage: Storage) -> None:
        """Time a view: compiled, NumPy, decoding."""
        for method, lit in self._forms.items():
            stored, test = storage.of(method), storage.tests[method.projector_scale]
            images = storage.view.range, stored.image, storage.view.facing
            known = np.flatnonzero(stored.image).astype(np.int32)  # as the loader has them of decoding
            forms = partial(lit, test, images, known), partial(method.lit, test, images)
            self._differing[method] += int((forms[0]() != forms[1]()).sum())
            fast, plain = (median_time(form, _ROUNDS * _RUNS)[0] for form in forms)
            self._times[method].append((fast, plain, stored.cost[1]))

    def rows(self, plain: dict[Method, dict[str, Any]]) -> list[dict[str, Any]]:
        """Rows of the JSON; plain: the rows of the NumPy forms. differing_pixels: between the two forms."""
        return [
            plain[method]
            | {
                "form": "compiled",
                "us_per_view": microseconds([time[0] + time[2] for time in self._times[method]]),
                "test_us": microseconds([time[0] for time in self._times[method]]),
                "decode_us": microseconds([time[2] for time in self._times[method]]),
                "numpy_test_us": microseconds([time[1] for time in self._times[method]]),
                "differing_pixels": self._differing[method],
            }
            for method in self._forms
        ]


class Masks:
    """The reference point: the exact mask, stored."""

    def __init__(self) -> None:
        self._costs: dict[str, list[tuple[int, float]]] = {}

    def add(self, view: ExactView) -> None:
        """Note the costs of a view."""
        for way, cost in exact_masks(view).items():
            self._costs.setdefault(way, []).append(cost)

    def row(self) -> dict[str, Any]:
        """Way of storing -> bytes and time."""
        return {
            way: {
                "bytes": round(statistics.mean(size for size, _ in costs)),
                "us_per_view": microseconds([seconds for _, seconds in costs]),
            }
            for way, costs in self._costs.items()
        }

    def method(self) -> dict[str, Any]:
        """The mask as an image of its own, as a row among the methods."""
        cost = self.row()[MASK_IMAGE]
        unused = dict.fromkeys(("bias", "projector_scale", "stored"))
        none = dict.fromkeys(("wrong_pixels", "false_lit", "false_shadow", "worst_view"), 0.0)
        name = f"exact mask, stored as {MASK_IMAGE}"
        return {"name": name, "family": "exact mask", "form": "numpy", "facing_bit": False, **unused, **none, **cost}


class WhereWrong:
    """Locations of the default's errors: beside exact shadow edges, under grazing light, every scene's worst window."""

    def __init__(self) -> None:
        self._wrong = self._beside = self._grazing = 0
        self.pixels = dict.fromkeys(SCENES, 0)
        self._crops: dict[str, dict[str, Any]] = {}

    def add(self, foreground: Foreground, lit: NDArray[np.bool_]) -> None:
        """Look at the default's mask of a view, bool [H, W]."""
        view = foreground.view
        wrong = (lit != view.lit) & view.inside
        for scene, mask in foreground.scenes.items():
            self.pixels[scene] += int(mask.sum())
            image = np.zeros_like(wrong)
            image.ravel()[foreground.pixels] = mask
            self._look_for_worst(scene, foreground, wrong & image)
        if foreground.group.name == ORDINARY:
            self._wrong += int(wrong.sum())
            self._beside += int((wrong & grown(view.lit) & grown(view.inside & ~view.lit)).sum())
            self._grazing += int((wrong & view.grazing).sum())

    def row(self) -> dict[str, Any]:
        """Shares of the errors in ordinary views."""
        return {
            "share_of_errors_beside_a_shadow_edge": share(self._beside, self._wrong),
            "share_of_errors_under_grazing_light": share(self._grazing, self._wrong),
        }

    def worst_crops(self) -> list[dict[str, Any]]:
        """For every scene the window that holds the most wrong pixels of it."""
        return [self._crops[scene] for scene in SCENES if scene in self._crops]

    def _look_for_worst(self, scene: str, foreground: Foreground, wrong: NDArray[np.bool_]) -> None:
        height, width = WORST_CROP
        sums = np.pad(wrong.astype(np.int32).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
        top, left = divmod(int(windows.argmax()), windows.shape[1])
        found = int(windows[top, left])
        if found > self._crops.get(scene, {"wrong": -1})["wrong"]:
            self._crops[scene] = {
                "scene": scene,
                "group": foreground.group.name,
                "pose": foreground.view.ref.pose,
                "distance_cm": foreground.view.view.distance_cm,
                "azimuth_deg": foreground.view.view.azimuth_deg,
                "top": top,
                "left": left,
                "wrong": found,
            }


def share(count: int, total: int) -> float:
    """`count` as a share of `total`, rounded; 0 if `total` is 0."""
    return round(count / max(total, 1), 6)


def microseconds(seconds: Sequence[float]) -> float:
    """The median of times in seconds."""
    return round(statistics.median(seconds) * 1e6, 1)
