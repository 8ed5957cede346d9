"""Filters of PNG, undone in a compiled loop (W3C, "Portable Network Graphics", 9.2)."""

from typing import Any

from bodyseg_data.machine import compiled


def _undo_filters(data: Any, step: Any, rows: Any) -> Any:
    """Write rows without their filters into `rows`, uint8 [H, W]; False if a row has another filter than 0 to 4.

    data: uint8 [H, 1 + W], each row behind its filter. step: bytes of a pixel.
    """
    height, width = rows.shape
    for row in range(height):
        kind = data[row, 0]
        if kind > 4:
            return False
        for i in range(width):
            rows[row, i] = data[row, 1 + i]
        if kind == 2 and row > 0:
            for i in range(width):
                rows[row, i] += rows[row - 1, i]
        elif kind == 1:
            for i in range(step, width):
                rows[row, i] += rows[row, i - step]
        elif kind >= 3:
            for i in range(width):
                left = int(rows[row, i - step]) if i >= step else 0
                above = int(rows[row - 1, i]) if row > 0 else 0
                corner = int(rows[row - 1, i - step]) if row > 0 and i >= step else 0
                if kind == 3:
                    expected = (left + above) // 2
                else:
                    to_left, to_above = abs(above - corner), abs(left - corner)
                    to_corner = abs(left + above - 2 * corner)
                    expected = corner
                    if to_left <= to_above and to_left <= to_corner:
                        expected = left
                    elif to_above <= to_corner:
                        expected = above
                rows[row, i] = (int(rows[row, i]) + expected) & 255
    return True


undo_filters: Any = compiled(_undo_filters, "decoding PNG in a compiled loop")
