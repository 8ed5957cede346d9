"""Pictures for people: contact sheets, and what all pictures share."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.drawing.contact_sheet import Row, colour_range, draw_sheet, span_of, span_text, window_of
    from bodyseg_data.drawing.style import (
        EMPTY,
        FAINT,
        INK,
        PAPER,
        THING,
        check_picture,
        colour_shares,
        draw_legend,
        fitted,
        font,
        new_chart,
        plain_axes,
        save_chart,
        save_picture,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
