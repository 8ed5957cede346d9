"""Rigs whose projector sees finer images than those that are stored."""

from dataclasses import replace

from bodyseg_data.rigs import Rig


def with_projector_scale(rig: Rig, factor: int) -> Rig:
    """The same rig with projector-view images of `factor` times as many pixels a side."""
    second = None if rig.second_projector is None else rig.second_projector.scaled(factor)
    return replace(rig, projector=rig.projector.scaled(factor), second_projector=second)
