"""Networks, their registry and their files."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.networks.body_map import UNIT_M, place_table
    from bodyseg_model.networks.checkpoints import (
        FINDER,
        SHIPPED,
        Checkpoint,
        Trained,
        check_trained,
        load_network,
        read_checkpoint,
        save_network,
        trained_network,
        wrapped,
    )
    from bodyseg_model.networks.names import CardWords, CheckpointName, NetworkName, RunFiles, confusion_file
    from bodyseg_model.networks.network import FlipAverage, Network, check_label_map, check_range_images, in_loops
    from bodyseg_model.networks.registry import (
        build,
        check_network,
        device_of,
        find_device,
        name_of,
        network_class,
        predict,
        predict_each,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
