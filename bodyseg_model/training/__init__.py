"""Training: shards and a recipe give a network."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.training.distributed import use_threads
    from bodyseg_model.training.loop import Diverged, RunOptions, Training, train
    from bodyseg_model.training.plan import RunFolder
    from bodyseg_model.training.recipes import GeometricAugmentation, OptimiserName, Recipe, RecipeName, recipe_for
    from bodyseg_model.training.turns import mixed
    from bodyseg_model.training.validation import DEFAULT_EVERY, WAITING_ADVICE, Metrics, Report, Validation
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
