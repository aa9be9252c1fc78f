"""`approxjac view`: a run → a page."""

from pathlib import Path

from approxjac.errors import InvalidInputError


def view(run: str, out: Path | None = None, title: str | None = None) -> int:
    """Make a page of a run, to see in a browser and to keep: one file that needs no network.

    Example: approxjac view results/simulate --out page.html

    Args:
        run: A run.npz that simulate, paper or Trajectory.save wrote, or a folder with one.
        out: The page, such as page.html; beside the run by default, and then it is opened too.
        title: Title of the page; by default it names the arm.
    """
    from approxjac.simulation import Trajectory
    from approxjac.view import save_page
    from approxjac.view.browser.page import open_browser

    if out is not None and not out.parent.is_dir():
        raise InvalidInputError(f"--out must be a file in an existing folder, got {out}", given=out)
    files = sorted(Path(run).glob("*.npz")) if Path(run).is_dir() else [Path(run)]
    if len(files) != 1:
        names = ", ".join(path.name for path in files) or "none"
        message = f"RUN must be a file, or a folder with one run (.npz), got {run} with {names}"
        raise InvalidInputError(message, given=run)
    (path,) = files
    beside = path.with_name(path.name.removesuffix(".npz") + ".html")
    page = save_page(Trajectory.load(path), out or beside, title)
    print(page)
    if out is None and not open_browser(page.resolve().as_uri()):
        print("No browser could be opened here: open it in yours")
    return 0
