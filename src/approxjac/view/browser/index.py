"""An index page of the run pages in a folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape
from pathlib import Path
from urllib.parse import quote

from approxjac.errors import InvalidInputError
from approxjac.validation import require
from approxjac.view.style import COLORS

_HEAD = 4000  # characters of a page in which its name stands
_MARK = '<meta name="generator" content="approxjac">'
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fff; }}
h1 {{ font-size: 1.5rem; }}
ul {{ list-style: none; padding: 0; display: grid; gap: 1rem; }}
li > * {{ display: block; padding: 1rem; border: 1px solid #ddd; border-radius: 6px; }}
a {{ color: {link}; text-decoration: none; }}
a:hover, a:focus {{ border-color: {link}; }}
img {{ display: block; max-width: 100%; max-height: 40rem; margin: 0 auto 0.5rem; }}
p {{ margin: 0.25rem 0 0; color: {text}; }}
</style>
</head>
<body>
<h1>{title}</h1>
<ul>
{entries}
</ul>
</body>
</html>
"""


def write_index(
    folder: str | Path, title: str = "Runs to look at", pictures: Mapping[str, str] | None = None
) -> Path:
    """Write index.html with a link to every run page in a folder, in the order of their names.

    A picture of the same name beside a page (run.png beside run.html) is shown with its link.

    Args:
        folder: With pages that `save_page` wrote.
        title: Of the index.
        pictures: Titles of pictures in the folder that have no page, by the names of their files;
            none by default. They are shown among the pages.

    Returns:
        The path of the index.

    Raises:
        InvalidInputError: A folder without such pages, or that cannot be written to, or a picture
            that is not in it.
    """
    folder = Path(folder)
    pictures = {} if pictures is None else pictures
    require("pictures", pictures, Mapping, 'titles by file names, such as {"map.png": "Map"}')
    try:
        entries = {}
        for path in folder.glob("*.html"):
            with path.open(encoding="utf-8", errors="replace") as file:
                head = file.read(_HEAD)
            if _MARK in head:
                entries[path.name] = _entry(path, head)
        if not entries:
            raise InvalidInputError(
                f"folder must hold pages that save_page(run, path) wrote, got {folder} without any",
                given=folder,
            )
        entries |= {name: _shown(folder, name, said) for name, said in pictures.items()}
        listed = "\n".join(entries[name] for name in sorted(entries, key=_natural))
        colors = {"link": COLORS["true"], "text": COLORS["neutral"]}
        index = folder / "index.html"
        index.write_text(_PAGE.format(title=escape(title), entries=listed, **colors), "utf-8")
    except OSError as error:
        raise InvalidInputError(
            f"folder must be one that can be read and written, got {folder}: {error}", given=folder
        ) from error
    return index


def _entry(path: Path, head: str) -> str:
    """Return a link to a page, with its title and its description of itself."""
    title = re.search(r"<title>(.+?)</title>", head, re.DOTALL)
    text = re.search(r'<meta name="description" content="(.+?)">', head, re.DOTALL)
    image = path.with_suffix(".png")
    picture = f'<img src="{quote(image.name)}" alt="">' if image.is_file() else ""
    named = title[1] if title else escape(path.stem)
    told = f"<p>{text[1]}</p>" if text else ""
    return f'<li><a href="{quote(path.name)}">{picture}<b>{named}</b>{told}</a></li>'


def _shown(folder: Path, name: str, title: str) -> str:
    """Return a picture without a page."""
    texts = isinstance(name, str) and isinstance(title, str)
    if not texts or Path(name).name != name or not (folder / name).is_file():
        raise InvalidInputError(
            f"pictures must be titles by the names of files in {folder}, got {name!r}: {title!r}",
            given=name,
        )
    return f'<li><div><img src="{quote(name)}" alt=""><b>{escape(title)}</b></div></li>'


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts fig10 after fig9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
