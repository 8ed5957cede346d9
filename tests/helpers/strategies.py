"""Property tests draw their samples here."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from bodyseg_data.labels import BACKGROUND, PART_COUNT
from bodyseg_data.samples import Sample, SampleInfo

keys = st.text("abcXYZ019_-+", min_size=1, max_size=80)


@st.composite
def samples(draw: st.DrawFn, projectors: int = 1) -> Sample:
    """Valid samples of any size and content, empty and full frames among them, of a rig with that many projectors."""
    shape = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    projector = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    ranges = draw(arrays.arrays(np.uint16, shape, elements=st.integers(0, 65535), fill=st.just(0)))
    labels = draw(arrays.arrays(np.uint8, shape, elements=st.integers(0, PART_COUNT - 1)))
    things = draw(st.sampled_from(["", "before", "both"]))
    on_thing = draw(arrays.arrays(np.bool_, shape)) & bool(things)
    facing, *second = (draw(arrays.arrays(np.bool_, shape)) & (ranges > 0) for _ in range(projectors))
    info = SampleInfo(
        source="open",
        subset=draw(st.sampled_from(["A", "people"])),
        subject=draw(keys),
        mesh=draw(keys),
        pose=draw(st.text(max_size=20)),
        distance_cm=draw(st.integers(50, 600)),
        azimuth_deg=draw(st.integers(0, 359)),
        split=draw(st.sampled_from(["train", "test"])),
        things=things,
        hidden_pct=draw(st.integers(0, 60)) if things else 0,
    )
    return Sample(
        key=draw(keys),
        range=ranges,
        projector_range=draw(arrays.arrays(np.uint16, projector, elements=st.integers(0, 65535), fill=st.just(0))),
        labels=np.where((ranges == 0) | on_thing, BACKGROUND, labels).astype(np.uint8),
        faces_projector=facing,
        info=info,
        faces_second=second[0] if second else None,
    )


def same(a: Sample, b: Sample) -> bool:
    """Whether two samples agree in every bit and type."""
    fields: tuple[str, ...] = ("range", "projector_range", "labels", "faces_projector")
    if a.faces_second is not None and b.faces_second is not None:
        fields += ("faces_second",)
    same_kind = (a.faces_second is None) == (b.faces_second is None)
    return (
        same_kind
        and (a.key, a.info) == (b.key, b.info)
        and all(
            getattr(a, field).dtype == getattr(b, field).dtype and np.array_equal(getattr(a, field), getattr(b, field))
            for field in fields
        )
    )
