"""Things of homes and workplaces, each drawn anew from random numbers `n`.

A thing stands on y = 0 around x = z = 0, in metres: x to the right, y up, its front towards -z. What is soft (cushions,
covers, coats, bags, leaves) is bent by waves. The height of a seat is drawn unless given.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import about
from bodyseg_data.meshes import Solid, cuboid, together, turned_solid
from bodyseg_data.packing import FURNITURE, Numbers

Point = tuple[float, float, float]

_STEP: Final = math.pi / 12
_RING: Final = [[(k, (k + 1) % 8, k + 8), ((k + 1) % 8, (k + 1) % 8 + 8, k + 8)] for k in range(8)]
_ENDS: Final = [[(0, k + 1, k), (8, k + 8, k + 9)] for k in range(1, 7)]
_TUBE: Final = np.array(_RING + _ENDS, np.int32).reshape(-1, 3)


def tube(points: list[Point], radius: float) -> Solid:
    """Cylinders of eight sides around a line through points."""
    start, end = np.array(points[:-1], np.float64), np.array(points[1:], np.float64)
    x, y, z = ((end - start) / np.maximum(np.sqrt(((end - start) ** 2).sum(axis=1)), 1e-9)[:, None]).T
    # At right angles to the line; `other`, its cross product with the line, is so, too.
    side = np.where(np.abs(y) > 0.9, (0 * x, z, -y), (-z, 0 * x, x))
    side = side / np.sqrt((side**2).sum(axis=0))
    other = np.stack([y * side[2] - z * side[1], z * side[0] - x * side[2], x * side[1] - y * side[0]])
    turns = [(radius * math.cos(3 * k * _STEP), radius * math.sin(3 * k * _STEP)) for k in range(8)]
    ring = np.stack([cos * side.T + sin * other.T for cos, sin in turns], 1)
    corners = np.concatenate([start[:, None] + ring, end[:, None] + ring], 1)
    faces = _TUBE + 16 * np.arange(len(x), dtype=np.int32)[:, None, None]
    return Solid(corners.reshape(-1, 3), faces.reshape(-1, 3))


def wheel(radius: float, centre: Point, spokes: int) -> Solid:
    """An upright wheel in the plane of the x of `centre`."""
    turns, (x, y, z) = [2 * math.pi * step / 16 for step in range(17)], centre
    rim: list[Point] = [(x, y + radius * math.sin(turn), z + radius * math.cos(turn)) for turn in turns]
    return together([tube(rim, 0.02), *(tube([centre, rim[step * 16 // spokes]], 0.006) for step in range(spokes))])


def _squares(rows: int, columns: int) -> NDArray[np.int32]:
    """Triangles between the points of a grid."""
    first = np.arange(rows * (columns + 1)).reshape(rows, columns + 1)[:, :-1].reshape(-1, 1)
    corners = [0, 1, columns + 2], [0, columns + 2, columns + 1]
    return np.concatenate([first + corner for corner in corners]).astype(np.int32)


@lru_cache
def _unit(cells: int) -> Solid:
    """A ball, or a cube whose sides have so many cells along each edge."""
    if not cells:
        return turned_solid([(math.sin(step * _STEP) / 2, -math.cos(step * _STEP) / 2) for step in range(1, 12)])
    u, v = (each.ravel() for each in np.meshgrid(*[np.linspace(-0.5, 0.5, cells + 1)] * 2))
    sides = []
    for axis, half in ((axis, half) for axis in range(3) for half in (-0.5, 0.5)):
        corners = np.roll(np.stack([u, v, np.full(u.shape, half)], 1), -axis, 1)
        sides.append(Solid(corners, _squares(cells, cells)[:, :: round(2 * half)]))
    return together(sides)


def slab(size_m: Point, centre: Point, cells: int = 8) -> Solid:
    """A cuboid whose sides have corners enough to be bent."""
    return Solid(_unit(cells).vertices * size_m + centre, _unit(cells).faces)


def ball(size_m: Point, centre: Point) -> Solid:
    """An ellipsoid. size_m: its three axes."""
    return slab(size_m, centre, 0)


def sheet(n: Numbers, width: float, height: float, fold: float, folds: float) -> Solid:
    """Cloth that hangs in folds of that depth in the plane z = 0, its lower edge at y = 0."""
    columns = max(24, int(8 * folds))
    across, up = np.meshgrid(np.linspace(-0.5, 0.5, columns + 1), np.linspace(0.0, 1.0, 5))
    drift = 0.9 * np.sin(2 * math.pi * across * n.between(0.5, 2.0) + n.between(0, 6.3))
    wave = fold * np.sin(2 * math.pi * folds * across + n.between(0, 6.3) + drift) * (1 - n.between(0.0, 0.7) * up)
    return Solid(np.stack([across * width, up * height, wave], -1).reshape(-1, 3), _squares(4, columns))


def bent(n: Numbers, solid: Solid, by_m: float, wave_m: float = 0.3) -> Solid:
    """The same with its corners moved by up to about `by_m`, in waves of about that length."""
    points, moved = solid.vertices, np.zeros_like(solid.vertices)
    for _ in range(4):
        ray = np.array([n.between(-1, 1) for _ in range(3)]) * (2 * math.pi / wave_m)
        way = np.array([n.between(-1, 1) for _ in range(3)]) * (by_m / 2)
        moved = moved + np.sin(points @ ray + n.between(0, 6.3))[:, None] * way
    return Solid(points + moved, solid.faces)


def tilted(solid: Solid, angle_rad: float, at: Point) -> Solid:
    """The same, rotated about the line through `at` along x."""
    return Solid((solid.vertices - at) @ about(angle_rad, 0).T + at, solid.faces)


def both(*solids: Solid) -> list[Solid]:
    """Solids and their mirror images at x = 0."""
    return [*solids, *(Solid(solid.vertices * (-1, 1, 1), solid.faces[:, ::-1]) for solid in solids)]


def legs(width: float, depth: float, height: float, thick: float, splay: float = 0.0) -> list[Solid]:
    """Four legs under a board of that width and depth, which stand out by a share `splay`."""
    x, ends = width / 2 - thick, (depth / 2 - thick, thick - depth / 2)
    return both(*(tube([(x * (1 + splay), 0, z * (1 + splay)), (x, height, z)], thick) for z in ends))


def star(height: float) -> list[Solid]:
    """Five feet, and the post on them."""
    ring = [(0.28 * math.cos(2 * math.pi * foot / 5), 0.28 * math.sin(2 * math.pi * foot / 5)) for foot in range(5)]
    feet = [tube([(0, 0.12, 0), (x, 0.07, z), (x, 0.0, z)], 0.025) for x, z in ring]
    return [*feet, tube([(0, 0.1, 0), (0, height, 0)], 0.03)]


def chair(n: Numbers, seat_m: float | None = None) -> Solid:
    """A chair with or without arms; its back is a board, of bars, of rungs, or one shell with the seat."""
    height, splay, kind = seat_m or n.between(0.4, 0.5), n.between(0.0, 0.3), n.whole(0, 4)
    width, depth, rise = n.between(0.38, 0.52), n.between(0.38, 0.5), n.between(0.3, 0.6)
    thick, x, z, lean = n.between(0.01, 0.025), width / 2 - 0.03, depth / 2 - 0.03, n.between(0.0, 0.15)
    seat = slab((width, n.between(0.02, 0.09), depth), (0, height - 0.03, 0))
    pieces = star(height) if not n.whole(0, 5) else legs(width, depth, height, thick, splay)
    if kind < 4:
        pieces += both(tube([(x, height, z), (x, height + rise, z + lean)], thick))
    if kind < 2:  # one board, with a gap below or not
        tall = rise * n.between(0.5, 1.0)
        board = bent(n, slab((width, tall, n.between(0.02, 0.06)), (0, height + rise - tall / 2, z)), 0.03, 0.8)
        pieces.append(tilted(board, lean, (0, height, z)))
    elif kind < 4:  # bars, and rungs or none
        at = [up / 4 for up in range(n.whole(2, 4), 5)]
        pieces += [cuboid((width - 0.04, 0.05, 0.02), (0, height + rise * up, z + lean * up)) for up in at]
        rungs = (-2, -1, 0, 1, 2) if kind == 3 else ()
        pieces += [tube([(x * at / 3, height, z), (x * at / 3, height + rise, z + lean)], 0.012) for at in rungs]
    else:
        shell = slab((width, 0.02, depth + rise), (0, height, rise / 2), 12)
        above = np.maximum(shell.vertices[:, 2] - depth / 2, 0.0)
        moved = np.outer(above, (0, 1, lean - 1)) + np.outer((shell.vertices[:, 0] / width) ** 2, (0, 0.12, 0))
        seat = Solid(shell.vertices + moved, shell.faces)
    if not n.whole(0, 2):
        pieces += both(tube([(x, height, -z), (x, height + 0.22, -z), (x, height + 0.22, z)], 0.02))
    return together([*pieces, bent(n, seat, 0.015)])


def office_chair(n: Numbers, seat_m: float | None = None) -> Solid:
    """A chair that turns and leans; its back is thick or thin, round or not, with arms and headrest or without."""
    height, lean, bow = seat_m or n.between(0.42, 0.56), n.between(-0.05, 0.3), n.between(0.0, 0.3)
    width, depth, rise = n.between(0.42, 0.54), n.between(0.4, 0.52), n.between(0.3, 0.75)
    made, grown = (ball, 1.15) if n.whole(0, 1) else (slab, 1.0)
    seat = made((width * grown, 0.1, depth * grown), (0, height - 0.05, 0))
    top = [made((width * n.between(0.75, 1.0), rise, n.between(0.03, 0.1)), (0, height + 0.12 + rise / 2, depth / 2))]
    if not n.whole(0, 2):
        top.append(slab((0.28, 0.16, 0.06), (0, height + rise + 0.24, depth / 2)))
    back = together(top)
    back = Solid(back.vertices - np.outer(bow * back.vertices[:, 0] ** 2 / width, (0, 0, 4)), back.faces)
    hold = tube([(0, height - 0.06, 0), (0, height - 0.05, depth / 2), (0, height + 0.3, depth / 2 + 0.05)], 0.025)
    pieces = [bent(n, seat, 0.025), tilted(bent(n, back, 0.025), lean, (0, height, depth / 2)), hold]
    if n.whole(0, 2):
        x, up = width / 2 + 0.03, height + n.between(0.14, 0.26)
        pieces += both(tube([(x * 0.7, height - 0.05, 0), (x, height, 0), (x, up, 0)], 0.02))
        pieces += both(slab((0.08, 0.03, 0.26), (x, up, 0), 3))
    return together([*star(height - 0.06), together(pieces).turned(n.between(-3, 3) if n.whole(0, 2) < 1 else 0.0)])


def folding_chair(n: Numbers, seat_m: float | None = None) -> Solid:
    """A folding chair: two crossed frames, a seat and a narrow back; at times folded."""
    height, x = seat_m or n.between(0.42, 0.48), n.between(0.18, 0.24)
    top, folded = height + n.between(0.3, 0.42), seat_m is None and not n.whole(0, 4)
    pieces = both(tube([(x, 0, -0.2), (x, height, 0.12), (x, top, 0.22)], 0.012))
    pieces += both(tube([(x - 0.03, 0, 0.24), (x - 0.03, height, -0.16)], 0.012))
    pieces.append(tilted(slab((2 * x, 0.02, 0.36), (0, height, 0)), 1.3 if folded else 0.0, (0, height, 0)))
    pieces.append(bent(n, slab((2 * x, n.between(0.1, 0.25), 0.015), (0, top - 0.06, 0.21)), 0.015, 1.0))
    made = together(pieces)
    return Solid(made.vertices * (1, 1, 0.25 if folded else 1), made.faces)


def stool(n: Numbers, seat_m: float | None = None) -> Solid:
    """A stool or a bar stool, round or square, on legs or on castors."""
    height, half = seat_m or n.between(0.4, 0.8), n.between(0.15, 0.22)
    seat = turned_solid([(half, height - 0.05), (half, height)])
    if n.whole(0, 1):
        seat = slab((2 * half, 0.06, 2 * half), (0, height - 0.03, 0))
    return together([seat, *(legs(1.5 * half, 1.5 * half, height, 0.018, 0.3) if n.whole(0, 2) else star(height))])


def armchair(n: Numbers, seat_m: float | None = None, narrowest: float = 0.5, widest: float = 0.7) -> Solid:
    """An armchair or a sofa, with cushions."""
    height, width = seat_m or n.between(0.38, 0.48), n.between(narrowest, widest)
    depth, rise, arm = n.between(0.55, 0.75), n.between(0.35, 0.55), n.between(0.1, 0.22)
    tall, outer, count = height + n.between(0.12, 0.25), width + 2 * arm, max(1, round(width / 0.65))
    pieces = [bent(n, slab((width, height - 0.1, depth), (0, height / 2, 0)), 0.02)]
    pieces.append(bent(n, slab((outer, height + rise, 0.2), (0, (height + rise) / 2, depth / 2 + 0.1)), 0.04))
    pieces += both(bent(n, slab((arm, tall, depth + 0.1), ((width + arm) / 2, tall / 2, 0)), 0.04))
    for x in ((number + 0.5) / count * width - width / 2 for number in range(count)):
        pieces.append(bent(n, ball((width / count * 1.05, 0.2, depth * 1.1), (x, height - 0.08, 0)), 0.03))
        pieces.append(bent(n, ball((width / count, rise * 1.1, 0.26), (x, height + rise / 2, depth / 2 - 0.03)), 0.04))
    return together(pieces)


def wheelchair(n: Numbers, seat_m: float | None = None) -> Solid:
    height, x, r = seat_m or n.between(0.46, 0.54), n.between(0.22, 0.27), n.between(0.28, 0.31)
    line = [(0.1, -0.5), (height, -0.22), (height, 0.22), (height + 0.48, 0.24), (height + 0.5, 0.36)]
    side = [tube([(x, up, along) for up, along in line], 0.015), cuboid((0.05, 0.03, 0.3), (x, height + 0.22, -0.02))]
    side += [cuboid((0.12, 0.02, 0.16), (x * 0.5, 0.1, -0.52)), wheel(0.09, (x, 0.09, -0.35), 3)]
    back = bent(n, slab((2 * x, 0.42, 0.03), (0, height + 0.24, 0.22)), 0.03, 0.5)
    seat = bent(n, slab((2 * x, 0.05, 0.44), (0, height - 0.025, 0)), 0.02)
    return together([seat, back, *both(*side, wheel(r, (x * 1.2, r, 0.1), 8))])


def clutter(n: Numbers, width: float, depth: float, height: float, most: int = 5, large: float = 1.0) -> list[Solid]:
    """Boxes, bottles and bags on a board of that size and height."""
    pieces = []
    for _ in range(n.whole(1, most)):
        x, z = n.between(-0.45, 0.45) * width, n.between(-0.4, 0.4) * depth
        kind, size = n.whole(0, 3), n.between(0.06, 0.2) * large
        if kind == 0:
            thing = cuboid((size * n.between(1, 2), size * n.between(0.3, 2), size), (0, 0, 0))
        elif kind == 1:
            thing = turned_solid([(size / 3, 0), (size / 3, size), (size / 9, 1.4 * size), (size / 9, 1.7 * size)])
        else:
            thing = bent(n, ball((2 * size, size * n.between(1, 2), 1.5 * size), (0, 0, 0)), 0.3 * size, 1.5 * size)
        thing = thing.turned(n.between(-3, 3))
        pieces.append(thing.moved((x, height - float(thing.vertices[:, 1].min()), z)))
    return pieces


def _topped(made: Callable[[Numbers], Solid], n: Numbers) -> Solid:
    """A thing, with others on it half of the time."""
    thing = made(n)
    width, height, depth = np.ptp(thing.vertices, axis=0)
    return together([thing, *(clutter(n, width, depth, height) if n.whole(0, 1) else [])])


def desk(n: Numbers) -> Solid:
    """A desk with one or two screens, a keyboard and clutter; a cupboard at a side."""
    width, height, depth = n.between(1.1, 1.8), n.between(0.68, 0.8), n.between(0.6, 0.8)
    pieces = [cuboid((width, 0.03, depth), (0, height, 0)), cuboid((0.42, 0.02, 0.14), (0, height + 0.025, -depth / 4))]
    pieces += both(cuboid((0.04, height, depth * 0.9), (width / 2 - 0.03, height / 2, 0)))
    if n.whole(0, 1):
        pieces.append(cuboid((0.4, height - 0.1, depth * 0.9), (width / 2 - 0.25, height / 2 + 0.03, 0)))
    for x in (-0.25, 0.35)[: n.whole(1, 2)]:
        wide = n.between(0.4, 0.65)
        screen = cuboid((wide, wide * 0.6, 0.03), (0, height + 0.12 + wide * 0.3, 0)).turned(n.between(-0.5, 0.5))
        screen = together([screen, tube([(0, height, 0.03), (0, height + 0.3, 0.02)], 0.03)])
        pieces.append(screen.moved((x, 0, depth / 5)))
    return together([*pieces, *clutter(n, width, depth, height + 0.015, 3)])


def shelf(n: Numbers) -> Solid:
    """A rack of boards with things on them, open or with a back."""
    width, height, depth, count = n.between(0.5, 1.4), n.between(0.9, 2.1), n.between(0.25, 0.45), n.whole(2, 5)
    pieces = both(cuboid((0.03, height, depth), (width / 2, height / 2, 0)))
    if n.whole(0, 1):
        pieces.append(cuboid((width, height, 0.01), (0, height / 2, depth / 2)))
    for at in (0.05 + (height - 0.07) * board / count for board in range(count + 1)):
        pieces.append(cuboid((width, 0.025, depth), (0, at, 0)))
        if at < height - 0.1 and n.whole(0, 4):
            pieces += clutter(n, width * 0.9, depth * 0.7, at + 0.0125)
    return together(pieces)


def bed(n: Numbers) -> Solid:
    """A bed with a cover in folds and pillows."""
    width, depth, height = n.between(1.8, 2.1), n.between(0.8, 1.6), n.between(0.35, 0.65)
    head = cuboid((0.05, height + n.between(0.1, 0.5), depth), (-width / 2, height / 2 + 0.15, 0))
    cover = slab((width * n.between(0.5, 0.95), 0.14, depth + 0.04), (width * 0.05, height - 0.05, 0), 24)
    pillow = bent(n, ball((0.4, 0.2, 0.55), (0.25 - width / 2, height + 0.05, 0)), 0.04, 0.4)
    pillows = [pillow.moved((0, 0, sign * depth / 4)) for sign in (-1, 1)[: n.whole(1, 2)]]
    frame = cuboid((width, height - 0.1, depth), (0, (height - 0.1) / 2, 0))
    return together([frame, head, bent(n, bent(n, cover, 0.06, 0.5), 0.04, 0.2), *pillows])


def bag(n: Numbers) -> Solid:
    """A bag, a rucksack or a sack."""
    size = n.between(0.25, 0.6), n.between(0.25, 0.7), n.between(0.15, 0.4)
    return bent(n, ball(size, (0, size[1] / 2, 0)), 0.08, 0.35)


def coat(n: Numbers, top_m: float) -> Solid:
    """A coat or a shirt that hangs from that height."""
    long, wide, deep = n.between(0.6, 1.15), n.between(0.35, 0.5), n.between(0.08, 0.22)
    elbow, down = wide * n.between(0.45, 0.65), n.between(0.5, 0.65)
    body = turned_solid([(n.between(0.4, 0.6), 0.0), (0.42, 0.55), (0.5, 0.86), (0.42, 0.94), (0.1, 1.0)])
    sleeve: list[Point] = [(wide * 0.42, -0.12 * long, 0), (elbow, -0.35 * long, 0.03), (elbow, -down, 0)]
    pieces = [Solid(body.vertices * (wide, long, deep) - (0, long, 0), body.faces), *both(tube(sleeve, 0.05))]
    return bent(n, bent(n, together(pieces), 0.05, 0.4), 0.03, 0.15).moved((0, top_m, 0))


def coat_stand(n: Numbers) -> Solid:
    """A coat stand with coats, a hat on it at times."""
    height = n.between(1.6, 1.85)
    pieces = [tube([(0, 0, 0), (0, height, 0)], 0.025), turned_solid([(0.22, 0), (0.2, 0.03)])]
    for turn in range(n.whole(1, 3)):
        hung = coat(n, height - n.between(0.05, 0.3)).moved((0, 0, -0.12))
        pieces.append(hung.turned(2.1 * turn + n.between(-0.5, 0.5)))
    return together([*pieces, *([] if n.whole(0, 2) else [ball((0.3, 0.16, 0.3), (0, height + 0.04, 0))])])


def dressed_chair(n: Numbers) -> Solid:
    """A chair with a coat over its back, or with a bag on it."""
    made = (chair, office_chair)[n.whole(0, 1)](n, 0.45)
    if not n.whole(0, 2):
        return together([made, bag(n).moved((0, 0.45, 0))])
    worn = coat(n, float(made.vertices[:, 1].max()) + 0.04)
    return together([made, Solid(worn.vertices * (1.1, 1, 1.6) + (0, 0, 0.25), worn.faces)])


def mannequin(n: Numbers) -> Solid:
    """A bust on a stand, with a head or without."""
    height, torso = n.between(1.1, 1.9), n.between(0.5, 0.8)
    body = (ball, slab)[n.whole(0, 1)]((n.between(0.25, 0.5), torso, n.between(0.15, 0.3)), (0, height - torso / 2, 0))
    stand = turned_solid([(0.2, 0), (0.18, 0.03), (n.between(0.02, 0.12), 0.06), (0.03, height - 0.1)])
    head = [ball((n.between(0.15, 0.3),) * 3, (0, height + 0.12, 0))] if n.whole(0, 2) else []
    return together([stand, bent(n, body, n.between(0.0, 0.06)), *head])


def cushions(n: Numbers, soft: float = 0.06) -> Solid:
    """Cushions, blankets or sacks, one on another."""
    pieces, top = [], 0.0
    for _ in range(n.whole(1, 5)):
        size = n.between(0.25, 0.7), n.between(0.1, 0.35), n.between(0.25, 0.6)
        one = (ball if soft and n.whole(0, 2) else slab)(size, (0, size[1] / 2, 0))
        one = bent(n, one, soft).turned(n.between(-1, 1))
        pieces.append(one.moved((n.between(-0.1, 0.1), top, n.between(-0.1, 0.1))))
        top += size[1] * (0.75 if soft else 1.0)
    return together(pieces)


def tall_plant(n: Numbers) -> Solid:
    """A plant with leaves, up to a person's height."""
    height, spread, pot = n.between(0.7, 1.9), n.between(0.15, 0.45), n.between(0.2, 0.45)
    pieces = [turned_solid([(0.12, 0.0), (0.17, pot)]), tube([(0, pot, 0), (n.between(-0.1, 0.1), height, 0)], 0.015)]
    for _ in range(n.whole(12, 40)):
        size, turn, up = n.between(0.08, 0.4), n.between(-3.2, 3.2), n.between(pot + 0.05, height)
        leaf = bent(n, slab((size * n.between(0.2, 0.5), 0.008, size), (0, 0, spread * n.between(0.3, 1.0)), 2), 0.03)
        pieces.append(tilted(leaf, n.between(-0.9, 0.9), (0, 0, 0)).turned(turn).moved((0, up, 0)))
    return together(pieces)


def bicycle(n: Numbers) -> Solid:
    """A bicycle that stands along x."""
    r, base, top = n.between(0.3, 0.36), n.between(0.95, 1.1), n.between(0.78, 0.95)
    hub, seat, head, pedals = (0, r, base / 2), (0, top, base * 0.2), (0, top, -base * 0.32), (0, 0.28, 0.05)
    lines: list[list[Point]] = [[hub, seat, head, pedals, seat], [hub, pedals], [head, (0, r, -base / 2)]]
    lines.append([(-0.25, top + 0.12, -base * 0.3), (0, top + 0.1, -base * 0.33), (0.25, top + 0.12, -base * 0.3)])
    wheels = [wheel(r, (0, r, z), 8) for z in (-base / 2, base / 2)]
    saddle = ball((0.15, 0.07, 0.26), (0, top + 0.05, base * 0.2))
    return together([*wheels, saddle, *(tube(line, 0.02) for line in lines)]).turned(math.pi / 2)


def robot_arm(n: Numbers) -> Solid:
    """An arm of a robot on a pedestal: four links with round joints."""
    thick, at, way = n.between(0.04, 0.08), np.array([0.0, n.between(0.05, 0.8), 0.0]), np.array([0.0, 1.0, 0.0])
    pieces = [cuboid((0.35, at[1], 0.35), (0, at[1] / 2, 0))]
    for _ in range(4):
        end = at + way * n.between(0.15, 0.45)
        pieces += [tube([tuple(at), tuple(end)], thick), ball((3 * thick,) * 3, tuple(end))]
        at, thick = np.maximum(end, (-9, 0.1, -9)), thick * 0.85
        way = np.add(way, (n.between(-1, 1), n.between(-0.7, 0.4), n.between(-1, 1)))
        way /= np.linalg.norm(way)
    return together(pieces)


def conveyor(n: Numbers) -> Solid:
    """A conveyor or a cable tray on posts."""
    long, height, depth = n.between(1.5, 3.5), n.between(0.4, 1.0), n.between(0.3, 0.7)
    pieces = [cuboid((long, 0.12, depth), (0, height - 0.06, 0)), *legs(long, depth, height, 0.03)]
    pieces += [cuboid((long, 0.1, 0.03), (0, height + 0.03, sign * depth / 2)) for sign in (-1, 1)]
    return together([*pieces, *clutter(n, long, depth, height, 6)])


def animal(n: Numbers) -> Solid:
    """A dog, or a toy of its shape."""
    long, height = n.between(0.4, 0.8), n.between(0.25, 0.45)
    pieces = [bent(n, ball((0.22, 0.24, long), (0, height, 0)), 0.03), *legs(0.2, long * 0.75, height, 0.03)]
    pieces += [tube([(0, height, side * long * 0.4), (0, height + 0.18, side * long * 0.55)], 0.04) for side in (-1, 1)]
    return together([*pieces, ball((0.15, 0.16, 0.24), (0, height + 0.2, -long * 0.58))])


def ladder(n: Numbers) -> Solid:
    """A stepladder, or a tripod."""
    height = n.between(0.8, 1.9)
    if n.whole(0, 1):
        feet = [(0.35 * math.cos(2.1 * foot), 0.0, 0.35 * math.sin(2.1 * foot)) for foot in range(3)]
        return together([ball((0.15,) * 3, (0, height, 0)), *(tube([foot, (0, height, 0)], 0.015) for foot in feet)])
    rails = both(*(tube([(0.22, 0, sign * height * 0.25), (0.16, height, 0)], 0.02) for sign in (-1, 1)))
    steps = [cuboid((0.36, 0.03, 0.08), (0, height * up / 6, height * (up - 6) / 24)) for up in range(1, 6)]
    return together([*rails, *steps])


def pillar(n: Numbers) -> Solid:
    """A pillar, a pipe or a post, round or square."""
    half, height = n.between(0.04, 0.25), n.between(1.2, 3.0)
    square = cuboid((2 * half, height, 2 * half), (0, height / 2, 0))
    return square if n.whole(0, 1) else turned_solid([(half, 0), (half, height)])


def appliance(n: Numbers) -> Solid:
    """A computer, a fan, a heater or a vacuum cleaner with its hose."""
    height, size = n.between(0.25, 0.9), n.between(0.2, 0.45)
    body = (ball, slab)[n.whole(0, 1)]((n.between(0.15, 0.4), height, n.between(0.2, 0.45)), (0, height / 2, 0))
    hose: list[Point] = [(0, height * 0.8, 0), (n.between(-0.3, 0.3), height + 0.3, 0.1)]
    hose += [(n.between(-0.5, 0.5), height + 0.2, -0.3), (0.3, 0.02, -0.5)]
    fan = ball((size, size, 0.15), (0, height * n.between(0.5, 1.4), 0))
    return together([bent(n, body, 0.02), tube(hose, 0.025), fan])


def sculpture(n: Numbers, first: int = 0, last: int = 2) -> Solid:
    """Bars, balls and slabs joined at random, half of them mirrored: art, toys, machines, and what has no name.

    first, last: of these shapes, the ones that are used.
    """
    pieces, ends = list[Solid](), [np.zeros(3)]
    for _ in range(n.whole(3, 14)):
        size, shape = (n.between(0.03, 0.3), n.between(0.03, 0.3), n.between(0.15, 0.8)), n.whole(first, last)
        at, turn = ends[n.whole(0, len(ends) - 1)], about(n.between(-3.2, 3.2)) @ about(n.between(-1.6, 1.6), 0)
        middle: Point = (0, 0, size[2] / 2)
        bar = tube([(0, 0, 0), (0, 0, size[2])], size[0] / 4)
        one = (bar, ball(size, middle), slab(size, middle, 4))[shape]
        pieces.append(Solid(one.vertices @ turn.T + at, one.faces))
        ends.append(at + turn @ middle * n.between(0.5, 2.0))
    made = bent(n, together(pieces), n.between(0.0, 0.08))
    made = together(both(made.moved((n.between(-0.1, 0.3), 0, 0)))) if n.whole(0, 1) else made
    low, high = made.vertices.min(axis=0), made.vertices.max(axis=0)
    base = (low + high) / 2 * (1, 0, 1) + low * (0, 1, 0)
    return Solid((made.vertices - base) * (n.between(0.3, 1.8) / float((high - low).max())), made.faces)


SEATS: Final[dict[str, Callable[..., Solid]]] = {
    **{made.__name__: made for made in (chair, office_chair, folding_chair, stool, armchair, wheelchair)},
    "sofa": partial(armchair, narrowest=1.2, widest=2.0),
}
"""Name -> what one sits on, drawn anew, with a seat of the height that is given, too, or drawn."""

_OTHERS: Final[tuple[Callable[[Numbers], Solid], ...]] = (
    *(desk, shelf, bed, tall_plant, bag, cushions, coat_stand, dressed_chair, mannequin, bicycle, robot_arm),
    *(conveyor, animal, ladder, pillar, appliance),
)
FURNISHINGS: Final[dict[str, Callable[[Numbers], Solid]]] = {
    **SEATS,
    **{made.__name__: made for made in _OTHERS},
    **{name: FURNITURE[name] for name in ("bin", "machine", "lamp", "plant")},
    **{name: partial(_topped, FURNITURE[name]) for name in ("table", "box")},
    "hanging": lambda n: sheet(n, n.between(0.3, 1.8), n.between(0.6, 2.2), n.between(0.01, 0.09), n.between(1, 12)),
    "heap": lambda n: cushions(n, 0.0),
    "sculpture": sculpture,
    **{name: partial(sculpture, first=at, last=at) for at, name in enumerate(("framework", "figure", "blocks"))},
    "pile": lambda n: together(clutter(n, n.between(0.5, 1.4), n.between(0.5, 1.2), 0.0, 12, n.between(1.0, 3.0))),
}
"""Name -> a thing of that kind, drawn anew."""
