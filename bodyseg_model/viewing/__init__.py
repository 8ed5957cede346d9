"""Sets and recordings in a browser: what is drawn, and the page that shows it."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.viewing.page import LOOPBACK, Page
    from bodyseg_model.viewing.recording_view import RecordingPage, RecordingView
    from bodyseg_model.viewing.set_page import SetPage
    from bodyseg_model.viewing.set_view import SetView, Shown
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
