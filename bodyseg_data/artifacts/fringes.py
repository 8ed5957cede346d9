"""What a pixel of a sensor with shifted fringes makes of its surface, and what a body looks like to it: the formulas of
`phase_shift`, written once.

NumPy applies `decode` to arrays, and `phase_loops` compiles it for one pixel. So it takes and makes float32 alone, and
every constant in it is one.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import FAR
from bodyseg_data.labels import PART_COUNT

REACH: Final = 2
"""Pixels to the neighbours that give slopes: over fewer of them, whole steps of a range make the slopes coarse."""
BEND_M: Final = 0.008
"""Slopes before and behind a pixel that differ by more, over `REACH` pixels, are those of two surfaces."""
EDGE_M: Final = 0.1
"""A pixel that was this much nearer or farther in another pattern saw another surface."""

_ZERO, _SIXTH, _QUARTER, _HALF, _ONE, _TWO = map(np.float32, (0, 1 / 6, 0.25, 0.5, 1, 2))
_LEAST: Final = np.float32(1e-6)
_EXPONENT: Final = np.int32(23)  # of a float32, behind its mantissa
_BIAS: Final = np.int32(127)
_BYTE, _EIGHT = np.uint32(255), np.uint32(8)
_MIDDLE, _SPREAD = np.float32(255), np.float32(math.sqrt(6 / (256**2 - 1)))
# Chebyshev fits: of sin(2 pi u) / (u (1/4 - u^2)) in u^2, and of arctan(a) / (2 pi a) in a^2, a <= 1.
_SINE: Final = tuple(map(np.float32, (25.132734, -64.83462, 67.03803, -38.06363, 12.073663)))
_ARCTAN: Final = tuple(map(np.float32, (0.15915422, -0.05299679, 0.03112896, -0.01927517, 0.00912444, -0.00213621)))


class Optics(NamedTuple):
    """What is the same for all pixels of an image, float32.

    A camera's ray (x, y, 1) times the range z meets the projector's fringe (z a + b) / (z c + d), of which a and c are
    across * x + down * y + ahead. light: the projector in the camera's frame, metres. See `PhaseShift` for others.
    """

    step_m: Any
    slope: Any  # metres of range a pixel times the focal length, of a step over 2 REACH pixels
    bend: Any  # BEND_M in steps
    across_a: Any
    down_a: Any
    ahead_a: Any
    b: Any
    across_c: Any
    down_c: Any
    ahead_c: Any
    d: Any
    light_x: Any
    light_y: Any
    light_z: Any
    square_m2: Any  # squared distance from the projector to the stand-off
    fringes: Any
    focus: Any  # 1 / range of the stand-off before the projector
    blur: Any
    signal: Any
    ambient: Any
    read: Any  # squared
    threshold: Any
    share: Any  # 1 / N
    cosine: Any  # of pi 2 / N
    sine: Any
    even: Any  # gamma's harmonics N + 1 and N - 1: sum and difference
    odd: Any
    random: Any  # sqrt(2 / N)
    period_s: Any  # between patterns
    drift_px: Any  # focal length times that
    finest: Any  # when the finest binary pattern is taken, patterns
    edge: Any
    found: Any  # normals below are those of jumps that the sensor finds


def pick(condition: Any, first: Any, second: Any) -> Any:
    """`first` where a condition holds, else `second`."""
    return np.where(condition, first, second)


def sine(turns: Any) -> Any:
    """The sine of an angle in turns, within 1e-6."""
    u = turns - np.rint(turns)
    v = u * u
    return u * (_QUARTER - v) * (_SINE[0] + v * (_SINE[1] + v * (_SINE[2] + v * (_SINE[3] + v * _SINE[4]))))


def angle(x: Any, y: Any) -> Any:
    """The angle of (x, y) in turns, -1/2 to 1/2, within 1e-6; 0 for (0, 0)."""
    wide, high = abs(x), abs(y)
    steep = high > wide
    a = pick(steep, wide, high) / (pick(steep, high, wide) + pick(wide + high > _ZERO, _ZERO, _ONE))
    v = a * a
    turns = _ARCTAN[0] + v * (_ARCTAN[1] + v * (_ARCTAN[2] + v * (_ARCTAN[3] + v * (_ARCTAN[4] + v * _ARCTAN[5]))))
    turns = turns * a
    turns = pick(steep, _QUARTER - turns, turns)
    turns = pick(x < _ZERO, _HALF - turns, turns)
    return pick(y < _ZERO, -turns, turns)


def slope(before: Any, here: Any, after: Any, bend: Any) -> Any:
    """Twice the difference to a neighbour: of both, or of the nearer one at an edge; 0 where neither is a surface."""
    forward, backward = after - here, here - before
    nearer = pick(abs(forward) <= abs(backward), forward, backward)
    one = pick(abs(nearer) < FAR * _HALF, _TWO * nearer, _ZERO)
    return pick(abs(forward - backward) <= bend, forward + backward, one)


def wave(turns: Any) -> Any:
    """A triangle wave, 1/4 at whole turns and -1/4 between them."""
    return _QUARTER - abs(turns - np.rint(turns))


def changes_at(boundary: Any, o: Any) -> Any:
    """When the one pattern of a Gray code is taken that changes from fringe `boundary` - 1 to it, patterns."""
    whole = np.int32(boundary)
    lowest = np.float32(whole & -whole)
    return o.finest - np.float32((lowest.view(np.int32) >> _EXPONENT) - _BIAS)


def decode(
    here: Any, left: Any, right: Any, above: Any, below: Any, x: Any, y: Any, look: Any, o: Any, first: Any, bits: Any
) -> Any:
    """What the sensor makes of a pixel: (error of its range in steps, 0 if lost else 1, columns and rows a pattern).

    here, left, ...: ranges of the pixel and of those REACH beside it, steps, `FAR` for background; x, y: its ray; look:
    the rows of `PhaseShift.looks` for its label; o: `Optics`; bits: uint32, drawn for it; first: their normal.
    """
    z = here * o.step_m
    p, q = x * z, y * z
    across, down = slope(left, here, right, o.bend) * o.slope, slope(above, here, below, o.bend) * o.slope
    ahead = z + x * across + y * down  # the normal is (-across, -down, ahead), and z its product with the ray

    # Light: cosine of the angle to the projector over its squared distance, 1 for a surface that faces it.
    to_x, to_y, to_z = o.light_x - p, o.light_y - q, o.light_z - z
    far = to_x * to_x + to_y * to_y + to_z * to_z
    faces = z * z + across * o.light_x + down * o.light_y - ahead * o.light_z
    light = faces * o.square_m2 / (np.sqrt((across * across + down * down + ahead * ahead) * far) * far)

    # The lower bits hardly move the normal: their bytes are another draw, whose sum is of one standard deviation, too.
    other = (np.float32(np.int32(bits & _BYTE) + np.int32((bits >> _EIGHT) & _BYTE)) - _MIDDLE) * _SPREAD

    # Cloth.
    one = wave(look[0] * p + look[1] * q + look[2] * z + look[3])
    two = wave(look[4] * p + look[5] * q + look[6] * z + look[7])
    albedo = pick(look[8] * one + look[9] * two + look[10] * one * two > _ZERO, look[11], look[12])

    # Fringes.
    c = o.across_c * x + o.down_c * y + o.ahead_c
    a = o.across_a * x + o.down_a * y + o.ahead_a
    w = z * c + o.d
    turn = a * o.d - o.b * c
    position = (z * a + o.b) / w
    away = _ONE / w - o.focus
    t = o.blur * away * away
    mean = o.signal * albedo * pick(light > _ZERO, light, _ZERO)
    amplitude = mean / (_ONE + t * (_ONE + t * (_HALF + t * _SIXTH)))  # exp(-t), to its third power
    sigma = np.sqrt(o.read + mean + o.ambient * albedo)

    # Motion.
    u = look[13] + look[17] * z - look[18] * q
    v = look[14] + look[18] * p - look[16] * z
    s = look[15] + look[16] * q - look[17] * p
    drift = turn / (w * w) * ((ahead * s - across * u - down * v) / z) * o.period_s  # fringes a pattern
    drift = pick(drift > o.share, o.share, pick(drift < -o.share, -o.share, drift))
    half = drift * _HALF
    low, high = sine(half), sine(half + _QUARTER)
    top = sine(half / o.share) * o.share
    turned = low * o.cosine + high * o.sine
    kept = pick(abs(low) > _LEAST, top / pick(abs(low) > _LEAST, low, _ONE), _ONE)
    ripple = top / pick(abs(turned) > _LEAST, turned, _ONE)
    double, many = o.share - _TWO * position, position / o.share
    random = o.random * sigma
    real = amplitude * (kept + ripple * sine(double + _QUARTER) + o.even * sine(many + _QUARTER)) + random * other
    imaginary = amplitude * (ripple * sine(double) + o.odd * sine(many)) + random * first

    # The count of fringes, by the two boundaries around; each is read when its pattern is taken.
    error = angle(real, imaginary)
    read = position + o.edge * sigma / pick(amplitude > _ONE, amplitude, _ONE) * other
    fringe = np.floor(position)
    after = fringe + _ONE
    below_it = (read + drift * changes_at(fringe, o) < fringe) & (fringe > _ZERO)
    above_it = (read + drift * changes_at(after, o) >= after) & (after < o.fringes)
    count = fringe - pick(below_it, _ONE, _ZERO) + pick(above_it, _ONE, _ZERO)
    jump = count - np.floor(position + error)
    lost = (real * real + imaginary * imaginary < o.threshold * o.threshold) | (light <= _ZERO)
    lost |= (position < _ZERO) | (position >= o.fringes) | ((jump != _ZERO) & (first < o.found))
    moved = error + jump
    metres = moved * w * w / (turn - moved * c * w)
    sideways = o.drift_px / z
    return metres / o.step_m, pick(lost, _ZERO, _ONE), sideways * (u - x * s), sideways * (v - y * s)


# Rigid parts of a body, each (labels, the part before it or -1, where it turns from its middle to that one's, limb).
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
_LIMB_M: Final = 0.6
"""From the joint of an arm to its end: what turns with the speed of an image over this moves about so fast there."""

_SKIN, _HAIR, _COAT, _TROUSERS, _SHOES, _THINGS = range(6)
_PELVIS: Final = [7, 8, 11, 12, 23, 24]


def _garments() -> NDArray[np.intp]:
    """Garment of each part, [34]; the last one is of what has no part."""
    worn = np.full(PART_COUNT + 1, _COAT)
    for garment, labels in (
        (_SKIN, [0, 2, 21, 22]),
        (_HAIR, [1]),
        (_TROUSERS, [*_PELVIS, *range(25, 31)]),
        (_SHOES, [31, 32]),
        (_THINGS, [PART_COUNT]),
    ):
        worn[labels] = garment
    return worn


_WORN: Final = _garments()


def fill(parts: Any, sums: Any, place: Any, cloth: Any, clothes: Any, motion: Any, tables: Any) -> None:
    """Write what `PhaseShift.looks` returns, transposed, into tables. Compiled, too, so it indexes arrays.

    place: metres of a step, focal length, centre and stand-off; cloth: its strengths, and speed of hands and feet, m/s;
    clothes, motion: drawn 32 bits each, [6, 12] and [108].
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
        garments[_TROUSERS] = garments[_COAT]  # a coat that reaches down

    # Where the rigid parts are, metres in the camera's frame; of one that is not seen, that before it.
    count = len(_BEFORE) if parts else 1
    totals, middles, moving = np.zeros((count + 1, 4), np.int64), np.zeros((count, 3)), np.zeros((count + 1, 6))
    for label in range(PART_COUNT + 1):
        totals[_PART_OF[label] if parts else 0] += sums[:, label]
    for part in range(count):
        pixels, middle, before = totals[part, 0], middles[part], _BEFORE[part]
        if pixels:
            middle[2] = totals[part, 3] / pixels * step_m
            middle[0] = (totals[part, 1] / pixels + 0.5 - centre_x) / focal * middle[2]
            middle[1] = (totals[part, 2] / pixels + 0.5 - centre_y) / focal * middle[2]
        elif before >= 0:
            middle[:] = middles[before]
        else:
            middle[2] = stand_off

    # Velocity at the camera and rotation of each.
    chances, own = motion * 2.0**-31 - 1.0, 6 * len(_LIMB)
    for part in range(count):
        much, before, at = speed * abs(chances[own + _LIMB[part]]), _BEFORE[part], 6 * part
        most, joint, moves = much / _LIMB_M, middles[part].copy(), 0.4 * much * chances[at + 3 : at + 6]
        turn = most * chances[at : at + 3]
        if before >= 0:
            joint += _SHARE[part] * (middles[before] - joint)
            moves = moving[before, :3] + cross(moving[before, 3:], joint)
            turn = moving[before, 3:] + turn
        moving[part, :3] = moves - cross(turn, joint)
        moving[part, 3:] = turn
    for label in range(PART_COUNT + 1):
        tables[label, :13] = garments[_WORN[label] if parts else _COAT]
        tables[label, 13:] = moving[_PART_OF[label] if parts else 0]


def cross(a: Any, b: Any) -> Any:
    """The cross product of two vectors [3]."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
