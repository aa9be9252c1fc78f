"""Plots of runs, of what cameras see and of stability; runs in the browser."""

from importlib.util import find_spec as _find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING or _find_spec("matplotlib"):
    from approxjac.view.browser.live import LiveView as LiveView
    from approxjac.view.browser.page import save_page as save_page
    from approxjac.view.browser.page import show as show
    from approxjac.view.browser.page import write_index as write_index
    from approxjac.view.calibrated import plot_accuracy as plot_accuracy
    from approxjac.view.calibrated import plot_determined as plot_determined
    from approxjac.view.calibrated import plot_residuals as plot_residuals
    from approxjac.view.calibrated import save_calibration_page as save_calibration_page
    from approxjac.view.plots import plot_command as plot_command
    from approxjac.view.plots import plot_error as plot_error
    from approxjac.view.plots import plot_image as plot_image
    from approxjac.view.plots import plot_parameters as plot_parameters
    from approxjac.view.plots import plot_path as plot_path
    from approxjac.view.plots import plot_run as plot_run
    from approxjac.view.plots import plot_shares as plot_shares
    from approxjac.view.plots import plot_slack as plot_slack
    from approxjac.view.plots import plot_torque as plot_torque
    from approxjac.view.style import COLORS as COLORS
    from approxjac.view.style import SERIES as SERIES
    from approxjac.view.style import legend_below as legend_below
    from approxjac.view.style import new_figure as new_figure
    from approxjac.view.style import save_figure as save_figure
    from approxjac.view.style import style as style
else:

    def __getattr__(name: str) -> object:
        """Raise a MissingPackageError, but for what Python itself looks for."""
        from approxjac.errors import package_of

        if not name.startswith("_"):
            package_of("study", "matplotlib")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
