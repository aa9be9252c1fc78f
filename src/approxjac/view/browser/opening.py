"""Opening a page in the user's browser."""

from __future__ import annotations

import os
import sys
import webbrowser


def open_browser(url: str) -> bool:
    """Open a page in the user's browser; returns whether there is one."""
    # without a screen, `webbrowser` would take a browser for terminals and wait until it is left
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        return False
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
