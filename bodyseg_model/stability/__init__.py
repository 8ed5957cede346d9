"""Robustness of trained networks to sensor artifacts of rising strength."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.stability.scenes import SWEEPS, Scenes, Sweep, chosen, of_rig
    from bodyseg_model.stability.summary import (
        FEWEST_SEEDS,
        Group,
        Run,
        draw_stability,
        evaluate_conditions,
        group,
        group_of,
        load_runs,
        summarise,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
