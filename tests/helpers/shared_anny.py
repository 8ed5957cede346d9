"""The body model Anny is loaded once a process: importing this module makes all sources of bodies share it.

Loading takes two seconds, cutting an outfit one, and dozens of tests open a source of their own. Nothing changes a
model that is loaded. It keeps bodies at rest, too: tests build the same people in one pose after another.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from bodyseg_data.bodies import anny_model as library
from bodyseg_data.bodies import anny_model as model


def shared(load: Callable[..., Any]) -> Callable[..., Any]:
    """The function `load_anny`, which keeps the model of each folder of Anny's cache."""
    models: dict[Any, Any] = {}

    @wraps(load)
    def load_shared() -> Any:
        try:
            import anny  # noqa: F401  # which a test may have made absent, though its modules are loaded
            from anny.paths import get_anny_cache_path
        except ImportError:
            return load()
        folder = get_anny_cache_path()
        if folder not in models:
            models[folder] = load()
            models[folder].get_rest_model = rest_kept(models[folder].get_rest_model)
        return models[folder]

    return load_shared


def rest_kept(make: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """The method, which keeps what it makes of a body's coefficients; whoever asks gets a dictionary of their own."""
    kept: dict[bytes, dict[str, Any]] = {}

    def rest_model(coefficients: Any) -> dict[str, Any]:
        key = coefficients.numpy().tobytes()
        if key not in kept:
            kept[key] = make(coefficients)
        return dict(kept[key])

    return rest_model


def shared_model(make: Callable[[], Any]) -> Callable[[], Any]:
    """The class `AnnyModel` as a function that makes one of each Anny."""
    made: dict[Any, Any] = {}

    def make_shared() -> Any:
        anny = library.load_anny()
        if anny not in made:
            made[anny] = make()
        return made[anny]

    return make_shared


library.load_anny = model.load_anny = shared(library.load_anny)
model.AnnyModel = shared_model(model.AnnyModel)  # type: ignore[assignment,misc]
