"""Counts of what a finder does in made rooms: pixels, people and things, by what is known of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np

from benches.model.rooms.finders import Found
from benches.model.rooms.made import HELD, Made
from benches.model.rooms.real import share
from bodyseg_data.labels import BACKGROUND, UNLABELLED

THRESHOLD: Final = 0.5
LEAST_SEEN_M2: Final = 0.1
"""Least visible surface of a person that counts as one, square metres, as if it faced the camera."""
_LEAST_THING_M2: Final = 0.02
_FOUND: Final = 0.5  # share of somebody's pixels
_LABELLED: Final = 0.3  # share of a thing's pixels

Row = dict[str, Any]

EDGES: Final = {
    "distance, m": (1.5, 2.5, 3.5, 4.5),
    "to the wall, m": (0.05, 0.15, 0.3, 0.5),
    "furniture in view": (0.1, 0.25, 0.5),
    "camera's pitch, degrees": (-20, -10, 0),
    "camera's height, m": (0.8, 1.3, 1.8),
}
"""Names of numbers by which people are counted -> limits between groups."""

WORDS: Final = ("sensor", "posture", "touches", "holds a thing")


def counted(room: Made, found: Found, threshold: float = THRESHOLD) -> dict[str, list[Row]]:
    """Rows of a frame: one of the frame, one for each person of at least `LEAST_SEEN_M2`, one for each thing."""
    labelled, measured = found.person >= threshold, room.range_m > 0
    area = np.square(room.range_m.astype(np.float64)) / room.camera.focal_px**2
    body = (room.person > 0) & (room.labels < UNLABELLED)
    held = np.array([False, *(kind == HELD for kind in room.kinds)])[room.thing] | (
        (room.person > 0) & ~body & measured
    )
    frame: Row = {
        "of": room.of,
        "number": room.number,
        "labelled": int(labelled.sum()),
        "own": int((labelled & body).sum()),
        "persons": int(body.sum()),
        "held": int(held.sum()),
        "held_labelled": int((labelled & held).sum()),
        "bodies": found.bodies,
    }
    about = {
        "sensor": room.sensor,
        "camera's pitch, degrees": room.pitch_deg,
        "camera's height, m": room.height_m,
        "furniture in view": float(((room.thing > 0) & ~held).sum() / max(int(measured.sum()), 1)),
    }
    people: list[Row] = []
    for number, who in enumerate(room.people):
        own = body & (room.person == number + 1)
        if area[own].sum() < LEAST_SEEN_M2:
            continue
        named = own & labelled & (found.labels != BACKGROUND if found.labels is not None else False)
        people.append(
            about
            | {
                "of": room.of,
                "number": room.number,
                "distance, m": float(np.median(room.range_m[own])),
                "to the wall, m": who.gap_m,
                "posture": who.posture,
                "touches": who.touches,
                "holds a thing": "yes" if who.holds else "no",
                "pixels": int(own.sum()),
                "found": int((own & labelled).sum()),
                "named": int(named.sum()),
                "right": int((named & (found.labels == room.labels)).sum()) if found.labels is not None else 0,
            }
        )
    things = []
    for number, kind in enumerate(room.kinds):
        own = room.thing == number + 1
        if kind != HELD and area[own].sum() >= _LEAST_THING_M2:
            counts = {"pixels": int(own.sum()), "labelled": int((own & labelled).sum())}
            things.append({"of": room.of, "number": room.number, "kind": kind, **counts})
    return {"frames": [frame], "people": people, "things": things}


def merged(tallies: Iterable[Mapping[str, list[Row]]]) -> dict[str, list[Row]]:
    """Rows of several frames together."""
    whole: dict[str, list[Row]] = {"frames": [], "people": [], "things": []}
    for each in tallies:
        for name, rows in each.items():
            whole[name] += rows
    return whole


def summary(tally: Mapping[str, list[Row]]) -> Row:
    """Figures of some frames: pixels' precision and recall, people lost, things labelled, parts right, held things."""
    frames, people, things = tally["frames"], tally["people"], tally["things"]
    bodies = [frame["bodies"] for frame in frames if frame["bodies"] is not None]
    return {
        "rooms": len(frames),
        "precision": share(_sum(frames, "own"), _sum(frames, "labelled")),
        "recall": share(_sum(frames, "own"), _sum(frames, "persons")),
        **_people(people),
        "things": len(things),
        "things_labelled": sum(thing["labelled"] > _LABELLED * thing["pixels"] for thing in things),
        "held_unlabelled": share(_sum(frames, "held") - _sum(frames, "held_labelled"), _sum(frames, "held")),
        "bodies_a_frame": round(float(np.mean(bodies)), 2) if bodies else None,
        "rooms_with_labels": sum(frame["labelled"] > 0 for frame in frames),
    }


def by_set(tally: Mapping[str, list[Row]]) -> dict[str, Row]:
    """`summary` of each set of rooms."""
    names = dict.fromkeys(frame["of"] for frame in tally["frames"])
    return {
        name: summary({kind: [row for row in rows if row["of"] == name] for kind, rows in tally.items()})
        for name in names
    }


def by_kind(things: Sequence[Row]) -> dict[str, Row]:
    """Things of each kind, and how many are labelled."""
    return {
        kind: {"things": len(own), "labelled": sum(thing["labelled"] > _LABELLED * thing["pixels"] for thing in own)}
        for kind in sorted({thing["kind"] for thing in things})
        for own in [[thing for thing in things if thing["kind"] == kind]]
    }


def by_property(tally: Mapping[str, list[Row]]) -> dict[str, dict[str, Row]]:
    """Figures of people in groups by what is known of them: precision in their frames, recall, lost, parts right."""
    frames = {(frame["of"], frame["number"]): frame for frame in tally["frames"]}
    found: dict[str, dict[str, Row]] = {}
    for name in (*EDGES, *WORDS):
        groups: dict[str, list[Row]] = {group: [] for group in _groups(name)}
        for person in tally["people"]:
            if person[name] is not None:
                groups.setdefault(_group(name, person[name]), []).append(person)
        found[name] = {
            group: {"precision": share(_sum(own, "own"), _sum(own, "labelled")), **_people(people)}
            for group, people in groups.items()
            if people
            for own in [[frames[key] for key in {(person["of"], person["number"]) for person in people}]]
        }
    return found


def _groups(name: str) -> list[str]:
    if name not in EDGES:
        return []
    edges = EDGES[name]
    between = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
    return [f"below {edges[0]:g}", *between, f"from {edges[-1]:g}"]


def _group(name: str, value: Any) -> str:
    return _groups(name)[int(np.searchsorted(EDGES[name], value, "right"))] if name in EDGES else str(value)


def _people(people: Sequence[Row]) -> Row:
    return {
        "people": len(people),
        "lost": sum(person["found"] < _FOUND * person["pixels"] for person in people),
        "recall": share(_sum(people, "found"), _sum(people, "pixels")),
        "parts_right": share(_sum(people, "right"), _sum(people, "named")),
    }


def _sum(rows: Iterable[Row], name: str) -> int:
    return sum(int(row[name]) for row in rows)
