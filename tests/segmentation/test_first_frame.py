"""The first frame after `Segmenter.prepare` finds every compiled loop loaded."""

from __future__ import annotations

import warm

PROGRAM = """
import torch
from bodyseg_data import RangeImages, example_set
from bodyseg_model.networks.checkpoints import load_network
from bodyseg_model.segmentation.carried_labels import CarriedLabels
from bodyseg_model.segmentation.segmenter import Segmenter

torch.set_num_threads(2)
trained = load_network()
segment = Segmenter(trained.network, trained.rig.camera, rig=trained.rig, video=CarriedLabels())
segment.prepare()
from bodyseg_model.networks import labelling, patch_loops
from bodyseg_model.segmentation import carried_loops, pixel_loops

modules = carried_loops, labelling, patch_loops, pixel_loops
loops = {f"{module.__name__}.{name}": loop for module in modules for name, loop in vars(module).items()
         if hasattr(loop, "nopython_signatures")}
before = {name: len(loop.nopython_signatures) for name, loop in loops.items()}
frame = RangeImages(example_set(), variant="none", split="test")[0]["range"][0].numpy()
assert all(segment(frame).bodies for _ in range(2))
print(sorted(name for name, loop in loops.items() if len(loop.nopython_signatures) != before[name]))
"""


def test_no_loop_is_loaded_by_the_first_frame_in_two_threads() -> None:
    done = warm.run(["-c", PROGRAM], timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"
