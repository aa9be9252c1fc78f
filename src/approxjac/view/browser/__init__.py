"""A run in a web browser: one page with the arm in motion and its plots, on MeshCat."""

from approxjac.view.browser.frames import Frames
from approxjac.view.browser.html import document, page, page_data, save_page, show
from approxjac.view.browser.stage import Stage

__all__ = ["Frames", "Stage", "document", "page", "page_data", "save_page", "show"]
