"""The folder, the progress bar and the browser view of commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from approxjac.errors import InvalidInputError

if TYPE_CHECKING:
    from approxjac.view.browser.live import LiveView


@dataclass(frozen=True)
class Live:
    """A run that is seen while it goes on.

    Attributes:
        view: Show it in the browser while it goes on; there the target and the believed length
            can be changed, and the run paused or stopped.
        speed: Of the run with --view, as a multiple of real time; 1 by default.
        port: Of the page with --view, on this machine; 7007 by default, or any free one.
    """

    view: tyro.conf.FlagCreatePairsOff[bool] = False
    speed: float | None = None
    port: int | None = None

    def observer(self, believe: Any, believed_length: float) -> LiveView | None:
        """Return the observer that shows the steps of `simulate`, if they are to be shown."""
        if not self.view:
            for name, value in (("speed", self.speed), ("port", self.port)):
                if value is not None:
                    raise InvalidInputError(
                        f"--{name} is for a run that is shown with --view, got {value:g} without",
                        given=value,
                    )
            return None
        from approxjac.view import LiveView

        return LiveView(
            speed=1.0 if self.speed is None else self.speed,
            port=self.port,
            believe=believe,
            believed_length=believed_length,
        )


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to.

    Raises:
        InvalidInputError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {error}", given=out
        ) from error


@contextmanager
def time_bar(duration: float, hidden: bool = False) -> Iterator[Callable[[float], None]]:
    """Show a progress bar over the time of a run, on a terminal only; yields what moves it."""
    from tqdm import tqdm

    # tqdm shows nothing where the output is not a terminal (disable=None)
    with tqdm(total=duration, unit="s", disable=True if hidden else None) as bar:
        yield lambda t: bar.update(t - bar.n) and None
