"""Things of homes and workplaces, each drawn anew from random numbers.

A thing stands on y = 0 around x = z = 0, in metres: x to the right, y up, its front towards -z. All are closed or thin
surfaces of triangles; what is soft (cushions, covers, coats, bags, leaves) is bent by waves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from bodyseg_data.meshes import Solid, cuboid, together, turned_solid
from bodyseg_data.packing.things import Numbers, bin_, box, lamp, machine, plant

Point = tuple[float, float, float]


def tube(points: list[Point], radius: float) -> Solid:
    """Cylinders of eight sides around a line through points."""
    around = np.arange(8) * (math.pi / 4)
    pieces = []
    for start, end in zip(np.asarray(points[:-1]), np.asarray(points[1:]), strict=True):
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        side = np.cross(along, (0.0, 1.0, 0.0) if abs(along[1]) < 0.9 else (1.0, 0.0, 0.0))
        side /= np.linalg.norm(side)
        ring = radius * (np.outer(np.cos(around), side) + np.outer(np.sin(around), np.cross(along, side)))
        here = np.arange(8)
        after = (here + 1) % 8
        walls = [np.stack([here, after, here + 8], 1), np.stack([after, after + 8, here + 8], 1)]
        ends = [[0, k + 1, k] for k in range(1, 7)] + [[8, 8 + k, 9 + k] for k in range(1, 7)]
        pieces.append(
            Solid(np.concatenate([start + ring, end + ring]), np.concatenate([*walls, ends]).astype(np.int32))
        )
    return together(pieces)


def wheel(across_m: float, thick_m: float, centre: Point, spokes: int) -> Solid:
    """An upright wheel in the plane x = `centre`[0]."""
    turns = [2 * math.pi * step / 16 for step in range(17)]
    x, y, z = centre
    rim: list[Point] = [(x, y + across_m * math.sin(turn), z + across_m * math.cos(turn)) for turn in turns]
    return together([tube(rim, thick_m), *(tube([centre, rim[step * 16 // spokes]], 0.006) for step in range(spokes))])


def ball(size_m: Point, centre: Point) -> Solid:
    """An ellipsoid. size_m: its three axes."""
    angles = [math.pi * step / 12 for step in range(1, 12)]
    unit = turned_solid([(math.sin(angle) / 2, -math.cos(angle) / 2) for angle in angles])
    return Solid(unit.vertices * np.asarray(size_m) + np.asarray(centre), unit.faces)


def slab(size_m: Point, centre: Point, cells: int = 12) -> Solid:
    """A cuboid whose sides have corners enough to be bent."""
    steps = np.linspace(-0.5, 0.5, cells + 1)
    u, v = (each.ravel() for each in np.meshgrid(steps, steps))
    half = np.full(u.shape, 0.5)
    number = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].ravel()
    square = np.stack([number, number + 1, number + cells + 2, number + cells + 1], 1)
    faces = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]]).astype(np.int32)
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            corners = np.stack([u, v, half * sign], 1)[:, np.roll((0, 1, 2), axis)]
            sides.append(Solid(corners * np.asarray(size_m) + np.asarray(centre), faces[:, :: sign or 1]))
    return together(sides)


def sheet(width_m: float, height_m: float, fold_m: float, folds: float, numbers: Numbers) -> Solid:
    """Cloth that hangs in folds in the plane z = 0, its lower edge at y = 0."""
    columns = max(24, int(8 * folds))
    across = np.linspace(-0.5, 0.5, columns + 1)
    phase, swing = numbers.between(0, 6.3), numbers.between(0.3, 1.0)
    drift = 0.3 * np.sin(2 * math.pi * across * numbers.between(0.5, 2.0) + numbers.between(0, 6.3))
    wave = fold_m * np.sin(2 * math.pi * folds * across + phase + 3 * drift)
    rows = np.linspace(0.0, 1.0, 5)
    x = np.broadcast_to(across * width_m, (5, columns + 1))
    y = np.broadcast_to(rows[:, None] * height_m, x.shape)
    z = wave * (1 - (1 - swing) * rows[:, None])
    number = np.arange(4 * (columns + 1)).reshape(4, columns + 1)[:, :-1].ravel()
    square = np.stack([number, number + 1, number + columns + 2, number + columns + 1], 1)
    faces = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]]).astype(np.int32)
    return Solid(np.stack([x, y, z], -1).reshape(-1, 3), faces)


def bent(solid: Solid, numbers: Numbers, by_m: float, wave_m: float = 0.3) -> Solid:
    """The same with its corners moved by up to about `by_m`, in waves of about that length."""
    points = solid.vertices
    moved = np.zeros_like(points)
    for _ in range(4):
        ray = np.array([numbers.between(-1, 1) for _ in range(3)]) * (2 * math.pi / wave_m)
        way = np.array([numbers.between(-1, 1) for _ in range(3)]) * (by_m / 2)
        moved += np.outer(np.sin(points @ ray + numbers.between(0, 6.3)), way)
    return Solid(points + moved, solid.faces)


def turned_about(solid: Solid, angle_rad: float, axis: int, at: Point) -> Solid:
    """The same, rotated about a line through `at` along an axis, 0 for x or 2 for z."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[one, one] = matrix[two, two] = math.cos(angle_rad)
    matrix[one, two], matrix[two, one] = -math.sin(angle_rad), math.sin(angle_rad)
    return Solid((solid.vertices - at) @ matrix.T + at, solid.faces)


# Seats. The height of the seat, and where a seat is part of the width, are drawn unless given.


def chair(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A chair of four legs, with or without arms; its back is of boards, of bars or one bent board."""
    height = seat_m or numbers.between(0.4, 0.5)
    width, depth, rise = numbers.between(0.38, 0.52), numbers.between(0.38, 0.5), numbers.between(0.3, 0.6)
    thick, x, z = numbers.between(0.015, 0.03), width / 2 - 0.03, depth / 2 - 0.03
    splay = numbers.between(0.0, 0.08)
    legs = [
        tube([(sx * (x + splay), 0, sz * (z + splay)), (sx * x, height, sz * z)], thick)
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    seat = slab((width, numbers.between(0.03, 0.09), depth), (0, height - 0.03, 0))
    lean, back = numbers.between(0.0, 0.15), []
    kind = numbers.whole(0, 2)
    if kind == 0:
        back = [bent(slab((width, rise, 0.03), (0, height + 0.1 + rise / 2, depth / 2)), numbers, 0.02, 1.0)]
    else:
        posts = [tube([(sx * x, height, z), (sx * x, height + rise, z + lean)], thick) for sx in (-1, 1)]
        count = numbers.whole(2, 4)
        if kind == 1:
            bars = [
                cuboid((width - 0.04, 0.05, 0.02), (0, height + rise * (n + 1) / count, z + lean * (n + 1) / count))
                for n in range(count)
            ]
        else:
            bars = [
                tube(
                    [
                        (x * (2 * n / (count + 2) - 1), height, z),
                        (x * (2 * n / (count + 2) - 1), height + rise, z + lean),
                    ],
                    0.012,
                )
                for n in range(1, count + 2)
            ]
            bars.append(cuboid((width, 0.06, 0.03), (0, height + rise, z + lean)))
        back = posts + bars
    arms: list[Solid] = []
    if not numbers.whole(0, 2):
        arms = [
            tube([(sx * x, height, -z), (sx * x, height + 0.22, -z), (sx * x, height + 0.22, z)], 0.02)
            for sx in (-1, 1)
        ]
    return together([*legs, bent(seat, numbers, 0.01), *back, *arms])


def office_chair(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A chair on a star of five feet with castors; its back is a cushion or a net, with arms or without."""
    height = seat_m or numbers.between(0.42, 0.56)
    width, depth, rise = numbers.between(0.44, 0.54), numbers.between(0.42, 0.52), numbers.between(0.4, 0.75)
    ring = [(0.3 * math.cos(2 * math.pi * n / 5), 0.3 * math.sin(2 * math.pi * n / 5)) for n in range(5)]
    pieces = [tube([(0, 0.12, 0), (px, 0.07, pz)], 0.022) for px, pz in ring]
    pieces += [ball((0.06, 0.06, 0.06), (px, 0.03, pz)) for px, pz in ring]
    pieces.append(tube([(0, 0.1, 0), (0, height - 0.06, 0)], 0.03))
    pieces.append(bent(slab((width, 0.09, depth), (0, height - 0.045, 0)), numbers, 0.025))
    back = slab(
        (width * numbers.between(0.8, 1.0), rise, numbers.between(0.03, 0.09)), (0, height + 0.12 + rise / 2, depth / 2)
    )
    hollow = numbers.between(0.0, 0.08)
    x = back.vertices[:, 0] / width
    back = Solid(back.vertices - np.outer(hollow * 4 * x**2, (0, 0, 1)), back.faces)
    pieces.append(turned_about(bent(back, numbers, 0.025), numbers.between(-0.05, 0.25), 0, (0, height, depth / 2)))
    pieces.append(
        tube([(0, height - 0.04, 0), (0, height - 0.02, depth / 2 + 0.05), (0, height + 0.3, depth / 2 + 0.06)], 0.025)
    )
    if numbers.whole(0, 2):
        for sign in (-1, 1):
            post = sign * (width / 2 + 0.03)
            pieces.append(tube([(post * 0.7, height - 0.04, 0), (post, height, 0), (post, height + 0.2, 0)], 0.02))
            pieces.append(slab((0.08, 0.03, 0.26), (post, height + 0.21, 0), 3))
    if not numbers.whole(0, 3):
        pieces.append(bent(slab((0.28, 0.16, 0.06), (0, height + rise + 0.24, depth / 2)), numbers, 0.02))
    return together(pieces)


def folding_chair(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A folding chair: two crossed frames, a seat and a narrow back."""
    height, x = seat_m or numbers.between(0.42, 0.48), numbers.between(0.18, 0.24)
    top = height + numbers.between(0.3, 0.42)
    frames = [tube([(s * x, 0, -0.2), (s * x, height, 0.12), (s * x, top, 0.22)], 0.012) for s in (-1, 1)]
    frames += [tube([(s * (x - 0.03), 0, 0.24), (s * (x - 0.03), height, -0.16)], 0.012) for s in (-1, 1)]
    seat = slab((2 * x, 0.02, 0.36), (0, height, 0))
    back = slab((2 * x, numbers.between(0.1, 0.25), 0.015), (0, top - 0.06, 0.21))
    return together([*frames, seat, bent(back, numbers, 0.015, 1.0)])


def stool(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A stool or a bar stool, round or square."""
    height, half = seat_m or numbers.between(0.4, 0.8), numbers.between(0.15, 0.22)
    seat = (
        turned_solid([(half, height - 0.05), (half, height)])
        if numbers.whole(0, 1)
        else slab((2 * half, 0.06, 2 * half), (0, height - 0.03, 0))
    )
    legs = [
        tube([(sx * half, 0, sz * half), (sx * half * 0.7, height - 0.04, sz * half * 0.7)], 0.018)
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    return together([seat, *legs])


def armchair(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """An armchair, or a sofa of two or three seats, with cushions."""
    return _upholstered(numbers, numbers.between(0.5, 0.7), seat_m)


def sofa(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A sofa of two or three seats, with cushions."""
    return _upholstered(numbers, numbers.between(1.2, 2.0), seat_m)


def _upholstered(numbers: Numbers, width: float, seat_m: float | None) -> Solid:
    height, depth, rise = (
        seat_m or numbers.between(0.38, 0.48),
        numbers.between(0.55, 0.75),
        numbers.between(0.35, 0.55),
    )
    arm, count = numbers.between(0.1, 0.22), max(1, round(width / 0.65))
    pieces = [bent(slab((width, height - 0.1, depth), (0, (height - 0.1) / 2 + 0.05, 0)), numbers, 0.02)]
    pieces.append(
        bent(slab((width + 2 * arm, height + rise, 0.2), (0, (height + rise) / 2, depth / 2 + 0.1)), numbers, 0.04)
    )
    for sign in (-1, 1):
        tall = height + numbers.between(0.12, 0.25)
        pieces.append(bent(slab((arm, tall, depth + 0.1), (sign * (width + arm) / 2, tall / 2, 0)), numbers, 0.04))
    for number in range(count):
        x = (number + 0.5) / count * width - width / 2
        pieces.append(bent(ball((width / count * 1.05, 0.2, depth * 1.1), (x, height - 0.08, 0)), numbers, 0.03))
        pieces.append(
            bent(ball((width / count, rise * 1.1, 0.26), (x, height + rise / 2, depth / 2 - 0.03)), numbers, 0.04)
        )
    return together(pieces)


# Other furniture.


def table(numbers: Numbers) -> Solid:
    """A table, on four legs or on one foot, with things on it half of the time."""
    width, height, depth = numbers.between(0.6, 1.8), numbers.between(0.45, 0.95), numbers.between(0.5, 0.9)
    thick = numbers.between(0.02, 0.05)
    if numbers.whole(0, 3):
        x, z = width / 2 - 0.05, depth / 2 - 0.05
        legs = [tube([(sx * x, 0, sz * z), (sx * x, height, sz * z)], thick) for sx in (-1, 1) for sz in (-1, 1)]
        top = cuboid((width, thick, depth), (0, height - thick / 2, 0))
    else:
        legs = [turned_solid([(0.3, 0), (0.28, 0.03), (0.05, 0.06), (0.04, height)])]
        top = turned_solid([(width / 2, height - thick), (width / 2, height)])
        depth = width * 0.7
    return together([top, *legs, *(clutter(numbers, width, depth, height) if numbers.whole(0, 1) else [])])


def clutter(numbers: Numbers, width: float, depth: float, height: float, most: int = 5) -> list[Solid]:
    """Boxes, bottles, bags and plants on a board of that size and height."""
    pieces = []
    for _ in range(numbers.whole(1, most)):
        x, z = numbers.between(-0.45, 0.45) * width, numbers.between(-0.4, 0.4) * depth
        kind, size = numbers.whole(0, 3), numbers.between(0.06, 0.18)
        if kind == 0:
            thing = cuboid((size * numbers.between(1, 2), size * numbers.between(0.3, 2), size), (0, 0, 0))
        elif kind == 1:
            thing = turned_solid([(size / 3, 0), (size / 3, size), (size / 9, 1.4 * size), (size / 9, 1.7 * size)])
        elif kind == 2:
            thing = bent(ball((2 * size, size, 1.5 * size), (0, 0, 0)), numbers, 0.03, 0.15)
        else:
            thing = together(
                [
                    turned_solid([(size / 3, 0), (size / 2, size / 2)]),
                    bent(ball((size * 1.5, size * 1.5, size * 1.5), (0, size, 0)), numbers, 0.06, 0.1),
                ]
            )
        thing = thing.turned(numbers.between(-3, 3))
        pieces.append(thing.moved((x, height - float(thing.vertices[:, 1].min()), z)))
    return pieces


def desk(numbers: Numbers) -> Solid:
    """A desk with one or two screens, a keyboard and clutter; a cupboard or a board at a side."""
    width, height, depth = numbers.between(1.1, 1.8), numbers.between(0.68, 0.8), numbers.between(0.6, 0.8)
    pieces = [cuboid((width, 0.03, depth), (0, height, 0))]
    pieces += [cuboid((0.04, height, depth * 0.9), (sign * (width / 2 - 0.03), height / 2, 0)) for sign in (-1, 1)]
    if numbers.whole(0, 1):
        pieces.append(cuboid((0.4, height - 0.1, depth * 0.9), (width / 2 - 0.25, height / 2 + 0.03, 0)))
    for number in range(numbers.whole(1, 2)):
        x, wide = (number - 0.4) * 0.6, numbers.between(0.4, 0.65)
        pieces.append(
            cuboid((wide, wide * 0.6, 0.03), (x, height + 0.12 + wide * 0.3, depth * 0.2)).turned(
                numbers.between(-0.3, 0.3)
            )
        )
        pieces.append(tube([(x, height, depth * 0.25), (x, height + 0.3, depth * 0.22)], 0.02))
        pieces.append(cuboid((0.22, 0.015, 0.18), (x, height + 0.02, depth * 0.2)))
    pieces.append(cuboid((0.42, 0.02, 0.14), (0, height + 0.025, -depth * 0.25)))
    return together([*pieces, *clutter(numbers, width, depth, height + 0.015, 3)])


def shelf(numbers: Numbers) -> Solid:
    """A rack of boards with things on them, open or with a back."""
    width, height, depth = numbers.between(0.5, 1.4), numbers.between(0.9, 2.1), numbers.between(0.25, 0.45)
    count = numbers.whole(2, 5)
    pieces = [cuboid((0.03, height, depth), (sign * width / 2, height / 2, 0)) for sign in (-1, 1)]
    if numbers.whole(0, 1):
        pieces.append(cuboid((width, height, 0.01), (0, height / 2, depth / 2)))
    for board in range(count + 1):
        at = 0.05 + (height - 0.07) * board / count
        pieces.append(cuboid((width, 0.025, depth), (0, at, 0)))
        if board < count and numbers.whole(0, 4):
            pieces += clutter(numbers, width * 0.9, depth * 0.7, at + 0.0125)
    return together(pieces)


def cupboard(numbers: Numbers) -> Solid:
    """A cupboard with doors and handles, or drawers."""
    width, height, depth = numbers.between(0.4, 1.6), numbers.between(0.6, 2.1), numbers.between(0.3, 0.65)
    columns, rows = max(1, round(width / 0.5)), numbers.whole(1, 4)
    pieces = [cuboid((width, height, depth), (0, height / 2, 0))]
    for column in range(columns):
        for row in range(rows):
            x, y = (column + 0.5) / columns * width - width / 2, (row + 0.5) / rows * height
            pieces.append(cuboid((width / columns - 0.02, height / rows - 0.02, 0.02), (x, y, -depth / 2)))
            pieces.append(cuboid((0.1, 0.015, 0.03), (x, y + 0.3 * height / rows, -depth / 2 - 0.02)))
    return together([*pieces, *(clutter(numbers, width, depth, height, 3) if numbers.whole(0, 1) else [])])


def bed(numbers: Numbers) -> Solid:
    """A bed with a cover in folds and pillows."""
    width, depth, height = numbers.between(1.8, 2.1), numbers.between(0.8, 1.6), numbers.between(0.35, 0.65)
    pieces = [cuboid((width, height - 0.1, depth), (0, (height - 0.1) / 2, 0))]
    pieces.append(cuboid((0.05, height + numbers.between(0.1, 0.5), depth), (-width / 2, height / 2 + 0.15, 0)))
    cover = slab((width * numbers.between(0.5, 0.95), 0.14, depth + 0.04), (width * 0.05, height - 0.05, 0), 24)
    pieces.append(bent(bent(cover, numbers, 0.06, 0.5), numbers, 0.04, 0.2))
    for sign in (-1, 1)[: numbers.whole(1, 2)]:
        pieces.append(
            bent(ball((0.4, 0.2, 0.55), (0.25 - width / 2, height + 0.05, sign * depth / 4)), numbers, 0.04, 0.4)
        )
    return together(pieces)


def bag(numbers: Numbers) -> Solid:
    """A bag, a rucksack or a sack."""
    size = numbers.between(0.25, 0.6), numbers.between(0.25, 0.7), numbers.between(0.15, 0.4)
    sack = bent(ball(size, (0, size[1] / 2, 0)), numbers, 0.08, 0.35)
    return Solid(sack.vertices * (1, 1, 1), sack.faces)


def coat(numbers: Numbers, top_m: float) -> Solid:
    """A coat or a shirt that hangs from that height."""
    long, wide = numbers.between(0.6, 1.15), numbers.between(0.35, 0.5)
    deep = numbers.between(0.08, 0.22)
    profile = [(0.1, 0.0), (0.42, 0.06), (0.5, 0.14), (0.42, 0.45), (numbers.between(0.4, 0.6), 1.0)]
    body = turned_solid([(radius, 1.0 - at) for radius, at in reversed(profile)])
    body = Solid(body.vertices * (wide, long, deep) + (0, top_m - long, 0), body.faces)
    sleeves = []
    for sign in (-1, 1):
        shoulder = (sign * wide * 0.42, top_m - 0.12 * long, 0.0)
        elbow = (sign * wide * numbers.between(0.45, 0.65), top_m - 0.35 * long, numbers.between(-0.05, 0.05))
        sleeves.append(tube([shoulder, elbow, (elbow[0], top_m - numbers.between(0.5, 0.65), elbow[2])], 0.05))
    return bent(bent(together([body, *sleeves]), numbers, 0.05, 0.4), numbers, 0.03, 0.15)


def coat_stand(numbers: Numbers) -> Solid:
    """A coat stand with coats, a hat on it at times."""
    height = numbers.between(1.6, 1.85)
    pieces = [tube([(0, 0, 0), (0, height, 0)], 0.025), turned_solid([(0.22, 0), (0.2, 0.03)])]
    for number in range(numbers.whole(1, 3)):
        hung = (
            coat(numbers, height - numbers.between(0.05, 0.3))
            .moved((0, 0, -0.12))
            .turned(2.1 * number + numbers.between(-0.5, 0.5))
        )
        pieces.append(hung)
    if not numbers.whole(0, 2):
        pieces.append(ball((0.3, 0.16, 0.3), (0, height + 0.04, 0)))
    return together(pieces)


def bicycle(numbers: Numbers) -> Solid:
    """A bicycle that stands along x."""
    r, base, top = numbers.between(0.3, 0.36), numbers.between(0.95, 1.1), numbers.between(0.78, 0.95)
    wheels = together([wheel(r, 0.02, (0, r, z), 8) for z in (-base / 2, base / 2)])
    hub, seat, head, pedals = (0, r, base / 2), (0, top, base * 0.2), (0, top, -base * 0.32), (0, 0.28, 0.05)
    bars = [
        tube([hub, seat, head, pedals, seat], 0.02),
        tube([hub, pedals], 0.02),
        tube([head, (0, r, -base / 2)], 0.02),
    ]
    bars.append(
        tube([(-0.25, top + 0.12, -base * 0.3), (0, top + 0.1, -base * 0.33), (0.25, top + 0.12, -base * 0.3)], 0.015)
    )
    bars.append(ball((0.15, 0.07, 0.26), (0, top + 0.05, base * 0.2)))
    return together([wheels, *bars]).turned(math.pi / 2)


def wheelchair(numbers: Numbers, seat_m: float | None = None) -> Solid:
    """A wheelchair."""
    height, half, r = seat_m or numbers.between(0.46, 0.54), numbers.between(0.22, 0.27), numbers.between(0.28, 0.31)
    pieces = [wheel(r, 0.02, (sign * (half + 0.05), r, 0.1), 8) for sign in (-1, 1)]
    pieces += [wheel(0.09, 0.02, (sign * half, 0.09, -0.35), 3) for sign in (-1, 1)]
    pieces.append(bent(slab((2 * half, 0.05, 0.44), (0, height - 0.025, 0)), numbers, 0.02))
    pieces.append(bent(slab((2 * half, 0.42, 0.03), (0, height + 0.24, 0.22)), numbers, 0.03, 0.5))
    for sign in (-1, 1):
        x = sign * half
        pieces.append(
            tube(
                [
                    (x, 0.1, -0.5),
                    (x, height, -0.22),
                    (x, height, 0.22),
                    (x, height + 0.48, 0.24),
                    (x, height + 0.5, 0.36),
                ],
                0.015,
            )
        )
        pieces.append(cuboid((0.05, 0.03, 0.3), (x, height + 0.22, -0.02)))
        pieces.append(cuboid((0.12, 0.02, 0.16), (x * 0.5, 0.1, -0.52)))
    return together(pieces)


def robot_arm(numbers: Numbers) -> Solid:
    """An arm of a robot on a pedestal: four links with round joints and a gripper."""
    thick, at = numbers.between(0.04, 0.08), np.array([0.0, numbers.between(0.0, 0.8), 0.0])
    pieces = [cuboid((0.35, max(0.05, at[1]), 0.35), (0, max(0.05, at[1]) / 2, 0))]
    way = np.array([0.0, 1.0, 0.0])
    for link in range(4):
        end = at + way * numbers.between(0.15, 0.45)
        pieces += [tube([tuple(at), tuple(end)], thick), ball((3 * thick,) * 3, tuple(end))]
        at, thick = end, thick * 0.85
        way = way + np.array([numbers.between(-1, 1), numbers.between(-0.7, 0.4), numbers.between(-1, 1)])
        way /= np.linalg.norm(way)
        at[1] = max(at[1], 0.1)
    return together([*pieces, cuboid((0.12, 0.04, 0.06), tuple(at + way * 0.05))])


def conveyor(numbers: Numbers) -> Solid:
    """A conveyor or a cable tray on posts."""
    long, height, depth = numbers.between(1.5, 3.5), numbers.between(0.4, 1.0), numbers.between(0.3, 0.7)
    pieces = [cuboid((long, 0.12, depth), (0, height - 0.06, 0))]
    pieces += [cuboid((long, 0.1, 0.03), (0, height + 0.03, sign * depth / 2)) for sign in (-1, 1)]
    posts = max(2, round(long))
    pieces += [
        tube(
            [
                (long * (n / (posts - 1) - 0.5) * 0.95, 0, s * depth / 2.2),
                (long * (n / (posts - 1) - 0.5) * 0.95, height, s * depth / 2.2),
            ],
            0.03,
        )
        for n in range(posts)
        for s in (-1, 1)
    ]
    return together([*pieces, *clutter(numbers, long, depth, height, 6)])


def animal(numbers: Numbers) -> Solid:
    """A dog, or a toy of its shape."""
    long, height = numbers.between(0.4, 0.8), numbers.between(0.25, 0.45)
    pieces = [bent(ball((0.22, 0.24, long), (0, height, 0)), numbers, 0.03)]
    pieces += [
        tube([(sx * 0.07, 0, sz * long * 0.36), (sx * 0.07, height, sz * long * 0.34)], 0.03)
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    pieces += [
        ball((0.15, 0.16, 0.24), (0, height + 0.2, -long * 0.58)),
        tube([(0, height, -long * 0.4), (0, height + 0.17, -long * 0.52)], 0.06),
    ]
    return together([*pieces, tube([(0, height + 0.05, long * 0.45), (0, height + 0.2, long * 0.62)], 0.02)])


def ladder(numbers: Numbers) -> Solid:
    """A stepladder, or a tripod."""
    height = numbers.between(0.8, 1.9)
    if numbers.whole(0, 1):
        feet = [(0.35 * math.cos(2.1 * n), 0.0, 0.35 * math.sin(2.1 * n)) for n in range(3)]
        return together(
            [*(tube([foot, (0, height, 0)], 0.015) for foot in feet), cuboid((0.15, 0.12, 0.12), (0, height + 0.05, 0))]
        )
    rails = [
        tube([(sx * 0.22, 0, sz * height * 0.25), (sx * 0.16, height, 0)], 0.02) for sx in (-1, 1) for sz in (-1, 1)
    ]
    steps = [cuboid((0.36, 0.03, 0.08), (0, height * n / 6, -height * 0.25 * (1 - n / 6))) for n in range(1, 6)]
    return together([*rails, *steps])


def heap(numbers: Numbers) -> Solid:
    """Boxes, one on another."""
    pieces, top = [], 0.0
    for _ in range(numbers.whole(1, 4)):
        size = numbers.between(0.2, 0.6), numbers.between(0.12, 0.5), numbers.between(0.2, 0.5)
        one = cuboid(size, (0, top + size[1] / 2, 0)).turned(numbers.between(-1, 1))
        pieces.append(one.moved((numbers.between(-0.08, 0.08), 0, numbers.between(-0.08, 0.08))))
        top += size[1]
    return together(pieces)


def pillar(numbers: Numbers) -> Solid:
    """A pillar, a pipe or a post, round or square."""
    half, height = numbers.between(0.04, 0.25), numbers.between(1.2, 3.0)
    return (
        turned_solid([(half, 0), (half, height)])
        if numbers.whole(0, 1)
        else cuboid((2 * half, height, 2 * half), (0, height / 2, 0))
    )


def hanging(numbers: Numbers) -> Solid:
    """A curtain, a towel or a sheet that hangs free, to the floor or not."""
    width, height = numbers.between(0.3, 1.8), numbers.between(0.6, 2.2)
    cloth = sheet(width, height, numbers.between(0.01, 0.09), numbers.between(0.5, 4) * max(1, 2 * width), numbers)
    return cloth.moved((0, numbers.between(0.0, 1.0) if height < 1.2 else 0.05, 0))


def tower(numbers: Numbers) -> Solid:
    """A computer, a fan, a heater or a vacuum cleaner: a box with a ball or a tube on it."""
    height, wide = numbers.between(0.3, 0.9), numbers.between(0.15, 0.35)
    pieces = [bent(slab((wide, height, numbers.between(0.2, 0.4)), (0, height / 2, 0)), numbers, 0.02)]
    if numbers.whole(0, 1):
        pieces.append(ball((numbers.between(0.2, 0.45),) * 2 + (0.15,), (0, height + 0.2, 0)))
    pieces.append(
        tube([(0, height * 0.8, 0), (0.1, height + 0.25, 0.05), (numbers.between(-0.3, 0.3), height + 0.6, 0.1)], 0.02)
    )
    return together(pieces)


SEATS: Final[dict[str, Callable[[Numbers, float | None], Solid]]] = {
    "chair": chair,
    "office_chair": office_chair,
    "folding_chair": folding_chair,
    "stool": stool,
    "armchair": armchair,
    "sofa": sofa,
    "wheelchair": wheelchair,
}
"""Name -> what one sits on, with a seat of that height."""

FURNISHINGS: Final[dict[str, Callable[[Numbers], Solid]]] = {
    **{name: (lambda numbers, made=made: made(numbers, None)) for name, made in SEATS.items()},
    "table": table,
    "desk": desk,
    "shelf": shelf,
    "cupboard": cupboard,
    "bed": bed,
    "box": box,
    "heap": heap,
    "bin": bin_,
    "machine": machine,
    "lamp": lamp,
    "plant": plant,
    "bag": bag,
    "coat_stand": coat_stand,
    "bicycle": bicycle,
    "robot_arm": robot_arm,
    "conveyor": conveyor,
    "animal": animal,
    "ladder": ladder,
    "pillar": pillar,
    "hanging": hanging,
    "tower": tower,
}
"""Name -> a thing of that kind, drawn anew."""
