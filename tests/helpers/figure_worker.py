"""A Dask worker preloads this file: it then packs the plain figures of `fakes`, and has the trouble it is told to have.

BODYSEG_TROUBLE names a folder. Files in it: `slow` makes every body take a while, `bad` makes one body's mesh bad,
`deadly` makes one body end the process that builds it. Every body begun but the first, by which
workers are compared before packing, leaves a file named after the process.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from fakes import Figures

from bodyseg_data.bodies import SOURCES, Body, BodyRef
from bodyseg_data.core import BadMesh

TROUBLE = Path(os.environ["BODYSEG_TROUBLE"])


class TroubledFigures(Figures):
    def build(self, body: BodyRef) -> Body:
        if body != self.bodies()[0]:
            (TROUBLE / f"begun-{os.getpid()}").touch()
        if (TROUBLE / "slow").exists():
            time.sleep(0.3)
        if (TROUBLE / "bad").exists() and body.mesh == "A-1":
            raise BadMesh(f"mesh {body.mesh}: faces must point outwards")
        if (TROUBLE / "deadly").exists() and body.mesh == "A-1":
            os._exit(1)
        return super().build(body)


SOURCES["open"] = TroubledFigures
