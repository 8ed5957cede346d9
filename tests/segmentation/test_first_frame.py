"""The first frame after `Segmenter.prepare` finds every compiled loop loaded."""

from __future__ import annotations

import warm

PROGRAM = """
import numpy as np, torch
from bodyseg_data.rigs.rig import load_sensor
from bodyseg_model.networks.checkpoints import load_network
from bodyseg_model.segmentation.segmenter import Segmenter

torch.set_num_threads(2)
camera, trained = load_sensor("kinect_v1").camera, load_network()
segment = Segmenter(trained.network, camera, rig=trained.rig)
segment.prepare()
from bodyseg_model.networks import labelling, patch_loops
from bodyseg_model.segmentation import pixel_loops

modules = labelling, patch_loops, pixel_loops
loops = {f"{module.__name__}.{name}": loop for module in modules for name, loop in vars(module).items()
         if hasattr(loop, "nopython_signatures")}
before = {name: len(loop.nopython_signatures) for name, loop in loops.items()}
frame = np.full((480, 640), 4.0, np.float32)
frame[80:440, 260:380] = 2.5
segment(frame)
print(sorted(name for name, loop in loops.items() if len(loop.nopython_signatures) != before[name]))
"""


def test_no_loop_is_loaded_by_the_first_frame_in_two_threads() -> None:
    done = warm.run(["-c", PROGRAM], timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"
