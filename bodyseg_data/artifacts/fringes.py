"""The formulas of `phase_shift`, once: the range that a pixel measures by shifted fringes; cloth and motion of a body.

NumPy applies `decode` to arrays; `sensor_loops` compiles it for one pixel. So it takes, makes and holds float32 alone.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np

from bodyseg_data.artifacts.constants import FAR
from bodyseg_data.labels import PART_COUNT

REACH: Final = 2
"""Pixels to the neighbours that give slopes: over fewer of them, whole steps of a range make the slopes coarse."""
BEND_M: Final = 0.008
"""A pixel is on one surface with those `REACH` before and behind it if their mean range is within this of its own."""
EDGE_M: Final = 0.1
"""A pixel that was this much nearer or farther in another pattern saw another surface."""
MARGIN: Final = 32
"""Background around an image, and how far a surface is followed in it, pixels."""

_ZERO, _SIXTH, _QUARTER, _HALF, _ONE, _TWO, _THREE = map(np.float32, (0, 1 / 6, 0.25, 0.5, 1, 2, 3))
_LEAST: Final = np.float32(1e-3)
_EXPONENT, _BIAS = map(np.int32, (23, 127))  # of a float32: bits of its mantissa, and the exponent of 1
_FAR_MOVED: Final = np.float32(MARGIN)
_PAIRS, _WORD, _EIGHT, _SIXTEEN = map(np.uint32, (0x00FF00FF, 0xFFFF, 8, 16))
_MIDDLE, _SPREAD = np.float32(510), np.float32(math.sqrt(3 / 65535))
# Chebyshev fit of arctan(a) / (2 pi a) in a^2, a <= 1.
_ARCTAN: Final = tuple(map(np.float32, (0.15915006, -0.05278817, 0.02946005, -0.01460222, 0.00378392)))


class Optics(NamedTuple):
    """Quantities that all pixels of an image share, float32.

    The point z (x, y, 1) of a camera's ray is on the projector's fringe (z a + b) / (z c + d), where a and c are the
    ray's products with `a` and `c`. light: the projector in the camera's frame, metres. Others: see `PhaseShift`.
    """

    step_m: Any
    slope: Any  # gradient, metres of range a pixel times focal length, of a step over 2 REACH pixels
    bend: Any  # 2 BEND_M in steps
    a: Any
    b: Any
    c: Any
    d: Any
    light: Any
    light_m2: Any  # squared distance to the projector
    square_m2: Any  # squared distance from the projector to the stand-off's point
    fringes: Any
    focus: Any  # 1 / range of the stand-off's point in the projector's frame
    blur: Any
    signal: Any
    ambient: Any
    read: Any  # squared
    threshold: Any
    random: Any  # sqrt(2 / N)
    period_s: Any  # between patterns
    drift_px: Any  # focal length times period_s
    apart: Any  # EDGE_M in steps
    most: Any  # 1 / N, the drift in fringes a pattern that leaves no modulation
    finest: Any  # time of the finest binary pattern, in patterns from the middle of the phase patterns
    middle: Any  # mean time of all binary patterns, likewise
    edge: Any
    found: Any  # the sensor finds a jump whose normal draw is below this
    curve: Any  # brightness of a fringe: the factors of a polynomial in squared turns
    patterns: Any  # for each pattern its shift, its time, and its weights in both sums


def pick(condition: Any, first: Any, second: Any) -> Any:
    """`first` where a condition holds, else `second`."""
    return np.where(condition, first, second)


def within(value: Any, most: Any) -> Any:
    """The value, or the nearer one of `most` and its negative."""
    return pick(value > most, most, pick(value < -most, -most, value))


def angle(x: Any, y: Any) -> Any:
    """The angle of (x, y) in turns, -1/2 to 1/2, within 4e-6; 0 for (0, 0)."""
    wide, high = abs(x), abs(y)
    steep = high > wide
    a = pick(steep, wide, high) / (pick(steep, high, wide) + pick(wide + high > _ZERO, _ZERO, _ONE))
    v = a * a
    turns = a * (_ARCTAN[0] + v * (_ARCTAN[1] + v * (_ARCTAN[2] + v * (_ARCTAN[3] + v * _ARCTAN[4]))))
    turns = pick(steep, _QUARTER - turns, turns)
    turns = pick(x < _ZERO, _HALF - turns, turns)
    return pick(y < _ZERO, -turns, turns)


def slope(before: Any, here: Any, after: Any, bend: Any) -> Any:
    """Twice the difference to a neighbour: of both, or of the nearer one at an edge; 0 where neither is a surface."""
    forward = pick(after > _ZERO, after, FAR) - here
    backward = here - pick(before > _ZERO, before, FAR)
    nearer = pick(abs(forward) <= abs(backward), forward, backward)
    one = pick(abs(nearer) < FAR * _HALF, _TWO * nearer, _ZERO)
    return pick(abs(forward - backward) <= bend, forward + backward, one)


def wave(turns: Any) -> Any:
    """A triangle wave, 1/4 at whole turns and -1/4 between them."""
    return _QUARTER - abs(turns - np.rint(turns))


def velocity(z: Any, x: Any, y: Any, look: Any) -> Any:
    """Velocity of a surface at a range on a ray, m/s."""
    across, down = look[13] + z * (look[17] - look[18] * y), look[14] + z * (look[18] * x - look[16])
    return across, down, look[15] + z * (look[16] * y - look[17] * x)


def sideways(here: Any, x: Any, y: Any, look: Any, o: Any, time: Any) -> Any:
    """Whole columns and rows that a surface has moved at the time of a pattern; see `decode` for the arguments."""
    z = here * o.step_m
    u, v, s = velocity(z, x, y, look)
    ratio = o.drift_px / z * time
    return within(np.rint(ratio * (u - x * s)), _FAR_MOVED), within(np.rint(ratio * (v - y * s)), _FAR_MOVED)


def total(patterns: Any, curve: Any, phases: Any, real: Any, imaginary: Any) -> Any:
    """Sums of the patterns' brightness, in phase and across it; see `add` for the arguments."""
    for shown in patterns:
        real, imaginary = add(shown, curve, phases, real, imaginary)
    return real, imaginary


def add(shown: Any, curve: Any, phases: Any, real: Any, imaginary: Any) -> Any:
    """Both sums with one more pattern. shown, curve: one of `Optics.patterns`, and `Optics.curve`. phases: the phase in
    the middle of all, its drift a pattern, how much that falls a pattern, gain of brightness a pattern, and its mean.
    """
    phase, drift, bend, gain, blur = phases
    turns = phase + shown[0] + shown[1] * (drift - shown[1] * bend)
    u = turns - np.rint(turns)
    v = u * u
    fringe = curve[0] + v * (
        curve[1] + v * (curve[2] + v * (curve[3] + v * (curve[4] + v * (curve[5] + v * curve[6]))))
    )
    image = (_ONE + shown[1] * gain) * (blur + fringe)
    return real + shown[2] * image, imaginary + shown[3] * image


def decode(
    here: Any, left: Any, right: Any, above: Any, below: Any, then: Any, since: Any, x: Any, y: Any, look: Any, o: Any,
    bits: Any,
) -> Any:  # fmt: skip
    """Measure a pixel as the sensor does: error of its range in steps, and whether it is kept.

    here, left, ...: ranges of the pixel, of those REACH beside it, and where its surface was in the first pattern and
    is in the last one, steps, 0 for background; x, y: its ray; look: the rows of `PhaseShift.looks` for its label; o:
    `Optics`; bits: uint32, drawn for it.
    """
    z = here * o.step_m
    nearness = _ONE / z
    across, down = slope(left, here, right, o.bend) * o.slope, slope(above, here, below, o.bend) * o.slope
    ahead = z + x * across + y * down  # the normal is (-across, -down, ahead), and z its product with the ray

    # Motion: its speed along the ray, metres a pattern.
    u, v, s = velocity(z, x, y, look)
    speed = (ahead * s - across * u - down * v) * (nearness * o.period_s)

    # Cloth.
    one = wave(z * (look[0] * x + (look[1] * y + look[2])) + look[3])
    two = wave(z * (look[4] * x + (look[5] * y + look[6])) + look[7])
    albedo = pick(look[8] * one + look[9] * two + look[10] * one * two > _ZERO, look[11], look[12])

    # Light: cosine of the angle to the projector over its squared distance; 1 at the stand-off, facing the projector.
    along = o.light[0] * x + (o.light[1] * y + o.light[2])
    away = z * (x * x + (y * y + _ONE)) - along
    far = z * (away - along) + o.light_m2
    faces = z * z + across * o.light[0] + down * o.light[1] - ahead * o.light[2]
    light = faces * o.square_m2 / (np.sqrt((across * across + down * down + ahead * ahead) * far) * far)
    gain = speed * (z * far - _THREE * away * faces) / (faces * far)
    mean = o.signal * albedo * light

    # Fringes. Noise and threshold are in multiples of the fringes' amplitude.
    a, c = o.a[0] * x + (o.a[1] * y + o.a[2]), o.c[0] * x + (o.c[1] * y + o.c[2])
    w = _ONE / (z * c + o.d)
    position, curve, scale = (z * a + o.b) * w, c * w, (a * o.d - o.b * c) * w * w
    lit = (faces > _ZERO) & (position >= _ZERO) & (position < o.fringes)
    t = o.blur * (w - o.focus) * (w - o.focus)
    blur = _ONE + t * (_ONE + t * (_HALF + t * _SIXTH))  # exp(t), by a polynomial of third degree
    share = blur / pick(mean > _LEAST, mean, _LEAST)
    sigma = np.sqrt(o.read + pick(lit, mean, _ZERO) + o.ambient * albedo) * share
    drift = within(scale * speed, o.most)
    bend = drift * curve * speed

    # Noise: sum and difference of two sums of two bytes are two independent, nearly normal draws.
    pairs = np.uint32((bits & _PAIRS) + ((bits >> _EIGHT) & _PAIRS))
    low, high = np.int32(pairs & _WORD), np.int32(pairs >> _SIXTEEN)
    first, other = (np.float32(np.int32(low + high)) - _MIDDLE) * _SPREAD, np.float32(np.int32(low - high)) * _SPREAD
    random = o.random * sigma
    phases = position - np.rint(position), drift, bend, gain, blur
    real, imaginary = total(o.patterns, o.curve, phases, random * other, random * first)

    # The count of fringes, by the Gray code. Between its patterns and the fringes a pixel may drift over one boundary
    # of fringes; only one pattern changes at that boundary.
    boundary = np.rint(position + drift * o.middle)
    whole = np.int32(boundary)
    lowest = np.float32(whole & -whole)
    time = o.finest - np.float32((lowest.view(np.int32) >> _EXPONENT) - _BIAS)
    read = position + o.edge * sigma * other + time * (drift - time * bend)
    count = pick(read < boundary, boundary - _ONE, boundary)
    count = pick(count < _ZERO, _ZERO, pick(count < o.fringes, count, o.fringes - _ONE))

    phase = angle(real, imaginary)
    moved = (count - position) + (phase - np.floor(phase))
    limit = o.threshold * share
    kept = lit & (real * real + imaginary * imaginary >= limit * limit)
    kept &= (np.rint(moved) == _ZERO) | (first >= o.found)
    kept &= (then > _ZERO) & (since > _ZERO) & (abs(then - here) <= o.apart) & (abs(since - here) <= o.apart)
    return pick(kept, moved / ((scale - moved * curve) * o.step_m), _ZERO), kept


# Rigid parts of a body: labels; the part that each hangs from, or -1; its joint, as a share of the way to there; limb.
_TRUNK, _HEAD = (tuple(range(3, 15)), -1, 0.0, 0), ((0, 1, 2), 0, 0.3, 1)
_ARMS = (((15,), 0, 0.2, 2), ((16,), 0, 0.2, 3), ((17,), 2, 0.5, 2), ((18,), 3, 0.5, 3), ((19,), 4, 0.5, 2))
_HANDS = (((20,), 5, 0.5, 3), ((21,), 6, 0.5, 2), ((22,), 7, 0.5, 3))
_LEGS = (((23,), 0, 0.2, 4), ((24,), 0, 0.2, 5), ((25, 27), 10, 0.5, 4), ((26, 28), 11, 0.5, 5))
_FEET = (((29,), 12, 0.5, 4), ((30,), 13, 0.5, 5), ((31,), 14, 0.5, 4), ((32,), 15, 0.5, 5))
CHAIN: Final = (_TRUNK, _HEAD, *_ARMS, *_HANDS, *_LEGS, *_FEET)
_BEFORE: Final = np.array([part[1] for part in CHAIN])
_SHARE: Final = np.array([part[2] for part in CHAIN])
_LIMB: Final = np.array([part[3] for part in CHAIN])
_PART_OF: Final = np.array(
    [next((at for at, part in enumerate(CHAIN) if label in part[0]), -1) for label in range(PART_COUNT + 1)]
)
DRAWN: Final = {"clothes": 6 * 12, "motion": 6 * len(CHAIN) + 6}
"""Purpose -> how many numbers of 32 bits `fill` takes."""
_LIMB_M: Final = 0.6
"""Length of an arm: a part that turns by (speed / this) rad/s moves with about that speed at its end."""

_SKIN, _HAIR, _COAT, _TROUSERS, _SHOES, _THINGS = range(6)
_WORN: Final = np.full(PART_COUNT + 1, _COAT)  # garment of each part; the last entry is for what has no part
_WORN[[0, 2, 21, 22]], _WORN[1], _WORN[31:33], _WORN[PART_COUNT] = _SKIN, _HAIR, _SHOES, _THINGS
_WORN[[7, 8, 11, 12, *range(23, 31)]] = _TROUSERS


def fill(parts: Any, place: Any, cloth: Any, sums: Any, clothes: Any, motion: Any, tables: Any) -> None:
    """Write what `PhaseShift.looks` returns, transposed, into tables. Compiled, too, so it indexes arrays, a number at
    a time: to compile assignments of rows takes longer than all else here.

    place: metres of a step, focal length, centre and stand-off; cloth: its strengths, and speed of hands and feet, m/s;
    clothes, motion: of `DRAWN`, [6, 12] and [108].
    """
    step_m, focal, centre_x, centre_y, stand_off = place
    coat, darkest, spread, patterned, speed = cloth
    garments = np.zeros((6, 13))
    for garment in range(6):
        chance = clothes[garment] * 2.0**-32
        light, other, bare = chance[8], chance[9], garment in (_SKIN, _HAIR)
        if bare:
            albedo = 0.15 + 0.3 * light if garment == _SKIN else 0.02 + 0.2 * light * light
        else:
            albedo = coat if garment == _COAT else darkest + spread * light * light
        along, up, pattern = chance[1] - 0.5, chance[2] - 0.5, int(3 * chance[0])
        length = math.sqrt(along * along + up * up + 1e-9)
        along, up, row = along / length, up / length, garments[garment]
        period_m = 0.08 + 0.17 * chance[4] if pattern == 2 else 0.015 + 0.065 * chance[4]
        second_m = period_m * (0.7 + 0.6 * chance[5])
        row[0], row[1], row[2], row[3] = along / period_m, up / period_m, (chance[3] - 0.5) / period_m, chance[6]
        row[4], row[5], row[6], row[7] = -up / second_m, along / second_m, (0.5 - chance[3]) / second_m, chance[7]
        row[10 if pattern == 1 else 8] = 1
        row[9] = pattern == 2
        row[11] = albedo
        row[12] = albedo if bare or chance[10] >= patterned else darkest + spread * other * other
    if clothes[_TROUSERS, 11] * 2.0**-32 < 0.25:
        for entry in range(13):
            garments[_TROUSERS, entry] = garments[_COAT, entry]  # a long coat covers them

    # Middles of the rigid parts, metres, camera's frame; a part that is not seen takes that of the one it hangs from.
    count = len(_BEFORE) if parts else 1
    totals, middles, moving = np.zeros((count + 1, 4), np.int64), np.zeros((count, 3)), np.zeros((count + 1, 6))
    for label in range(PART_COUNT + 1):
        part = _PART_OF[label] if parts else 0
        for entry in range(4):
            totals[part, entry] += sums[entry, label]
    for part in range(count):
        pixels, middle, before = totals[part, 0], middles[part], _BEFORE[part]
        if pixels:
            middle[2] = totals[part, 3] / pixels * step_m
            middle[0] = (totals[part, 1] / pixels + 0.5 - centre_x) / focal * middle[2]
            middle[1] = (totals[part, 2] / pixels + 0.5 - centre_y) / focal * middle[2]
        elif before >= 0:
            middle[0], middle[1], middle[2] = middles[before, 0], middles[before, 1], middles[before, 2]
        else:
            middle[2] = stand_off

    # Velocity at the camera and rotation of each part: those of the part it hangs from, and a turn about their joint.
    chances, own = motion * 2.0**-31 - 1.0, 6 * len(_LIMB)
    joint, turn = np.zeros(3), np.zeros(3)
    for part in range(count):
        much, before, at = speed * abs(chances[own + _LIMB[part]]), _BEFORE[part], 6 * part
        for entry in range(6):
            moving[part, entry] = moving[before, entry]
        for axis in range(3):
            joint[axis] = middles[part, axis] + _SHARE[part] * (middles[before, axis] - middles[part, axis])
            turn[axis] = much / _LIMB_M * chances[at + axis]
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            moving[part, axis] -= turn[one] * joint[two] - turn[two] * joint[one]
            moving[part, 3 + axis] += turn[axis]
            if before < 0:
                moving[part, axis] += 0.4 * much * chances[at + 3 + axis]
    for label in range(PART_COUNT + 1):
        worn, part = (_WORN[label], _PART_OF[label]) if parts else (_COAT, 0)
        for entry in range(13):
            tables[label, entry] = garments[worn, entry]
        for entry in range(6):
            tables[label, 13 + entry] = moving[part, entry]
