"""Property tests draw their samples here."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.samples import Sample, SampleInfo

keys = st.text("abcXYZ019_-+", min_size=1, max_size=80)


@st.composite
def samples(draw: st.DrawFn, projectors: int = 1) -> Sample:
    """Valid samples of any size and content, empty and full frames among them, of a rig with that many projectors."""
    shape = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    projector = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    ranges = draw(arrays.arrays(np.uint16, shape, elements=st.integers(0, 65535), fill=st.just(0)))
    labels = draw(arrays.arrays(np.uint8, shape, elements=st.integers(0, 32)))
    on_thing = draw(arrays.arrays(np.bool_, shape))
    facing, *second = (draw(arrays.arrays(np.bool_, shape)) & (ranges > 0) for _ in range(projectors))
    names = st.text("abcdefghijklmnopqrstuvwxyz_0123456789", min_size=1, max_size=20).map(lambda text: f"x{text}")
    numbers = st.floats(allow_nan=False, allow_infinity=False)
    values = st.one_of(
        st.text(st.characters(categories=("L", "N", "P", "S")), max_size=20),
        st.integers(-(2**53) + 1, 2**53 - 1),
        numbers,
        st.booleans(),
        st.lists(numbers, max_size=16).map(tuple),
    )
    fields = draw(st.dictionaries(names, values, max_size=8))
    info = SampleInfo(draw(st.sampled_from(["train", "test"])), fields)
    planes = draw(st.dictionaries(st.sampled_from(["instances", "materials"]), st.sampled_from([np.uint8, np.uint16])))
    return Sample(
        key=draw(keys),
        range=ranges,
        projector_range=draw(arrays.arrays(np.uint16, projector, elements=st.integers(0, 65535), fill=st.just(0))),
        labels=np.where(ranges == 0, BACKGROUND, np.where(on_thing, UNLABELLED, labels)).astype(np.uint8),
        faces_projector=facing,
        info=info,
        faces_second=second[0] if second else None,
        planes={name: draw(arrays.arrays(kind, shape)) for name, kind in planes.items()},
    )


def same(a: Sample, b: Sample) -> bool:
    """Whether two samples agree in every bit and type."""
    fields: tuple[str, ...] = ("range", "projector_range", "labels", "faces_projector")
    if a.faces_second is not None and b.faces_second is not None:
        fields += ("faces_second",)
    same_kind = (a.faces_second is None) == (b.faces_second is None)
    return (
        same_kind
        and a.planes.keys() == b.planes.keys()
        and all(a.planes[name].dtype == b.planes[name].dtype for name in a.planes)
        and all(np.array_equal(a.planes[name], b.planes[name]) for name in a.planes)
        and (a.key, a.info) == (b.key, b.info)
        and all(
            getattr(a, field).dtype == getattr(b, field).dtype and np.array_equal(getattr(a, field), getattr(b, field))
            for field in fields
        )
    )
