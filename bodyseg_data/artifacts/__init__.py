"""Artifacts of structured-light sensors, and the five variants."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
    from bodyseg_data.artifacts.cast_shadow import seen_by_projectors
    from bodyseg_data.artifacts.lost_pixels import SHAPES, Losses, PatchLoss, StripeLoss
    from bodyseg_data.artifacts.missing_data import MissingData
    from bodyseg_data.artifacts.mixed_pixels import MixedPixels
    from bodyseg_data.artifacts.noise import Noise
    from bodyseg_data.artifacts.occlusion import Occlusion, ShadowTest, framed, lit_pixels, shadow_tests
    from bodyseg_data.artifacts.phase_shift import PhaseShift
    from bodyseg_data.artifacts.registry import artifact_class
    from bodyseg_data.artifacts.sensor_model import (
        PAPER_SENSOR,
        SensorModel,
        artifacts_to_json,
        load_sensor_model,
        parse_artifacts,
        sensor_model_from_json,
        sensor_model_names,
    )
    from bodyseg_data.artifacts.variants import (
        PAIRS,
        VARIANTS,
        Augmentation,
        VariantName,
        check_variant,
        kinds_of,
        sensor_for,
        shown_with,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
