"""Runs the examples when the site is built, and makes a page of each and a gallery of them all.

With APPROXJAC_RESULTS in the environment, what they left in that folder is shown instead.

Nothing is listed by hand: what is said of an example is its own header, what is shown are the files
that it says it made, and its robot as the first of its pages shows it. That takes a browser; where
there is none, the first of its plots is shown instead.
"""

import ast
import logging
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import dedent

from study_figures import ROOT, gather

from approxjac.view import write_index

sys.path.insert(0, str(ROOT / "docs"))
from page_picture import at, opened, save

FOLDER = ROOT / "examples"
SHOWN = "results/examples"  # what a page calls the folder that files were written to
CARD = (640, 360)
MOMENT = 0.15  # of a run at which its robot is shown: most have their way before them


@dataclass(frozen=True)
class Story:
    """An example that was run, and what it left.

    Attributes:
        path: Of the example.
        pictures: The PNGs that it made, one or more.
        pages: The pages of runs that it made.
        printed: What it printed beside the paths of its files.
        robot: A picture of its arm, or None.
    """

    path: Path
    pictures: list[Path]
    pages: list[Path]
    printed: str
    robot: Path | None = None

    @property
    def title(self):
        """Number and name of the file, as words."""
        number, _, name = self.path.stem.partition("_")
        words = name.replace("_", " ")
        return f"{int(number)}. {words[0].upper()}{words[1:]}"

    @property
    def summary(self):
        """The first line of its header, on one line."""
        return " ".join(self._header()[0].split())

    @property
    def text(self):
        """What else its header says, but for the commands, as Markdown."""
        return "\n\n".join(part for part in self._header()[1:] if not part.startswith("    "))

    @property
    def commands(self):
        """What its header has one type, a line each."""
        return "\n".join(dedent(part) for part in self._header() if part.startswith("    "))

    def _header(self):
        return ast.get_docstring(ast.parse(self.path.read_text(encoding="utf-8"))).split("\n\n")


def examples():
    """The examples in the order of their numbers."""
    return sorted(FOLDER.glob("[0-9][0-9]_*.py"))


def run(path, out):
    """Run an example as a user does.

    Raises:
        RuntimeError: It failed.
    """
    print(f"running examples/{path.name}", flush=True)  # all of them take minutes
    process = subprocess.run(
        [sys.executable, str(path), "--out", str(out)], capture_output=True, text=True
    )
    if process.returncode != 0:
        raise RuntimeError(f"{path.name} ended with {process.returncode}:\n{process.stderr}")
    return story(path, process.stdout)


def left(path, folder, out):
    """Copy what an example left in a folder of its own, beside the text that it printed."""
    out.mkdir(parents=True, exist_ok=True)
    for file in (folder / path.stem).iterdir():
        if file.is_file():  # a folder is of C
            shutil.copy(file, out)
    return story(path, (folder / f"{path.stem}.txt").read_text(encoding="utf-8"))


def story(path, printed):
    """What an example tells of itself by its header and by what it printed.

    Raises:
        RuntimeError: It made no picture.
    """
    lines = printed.splitlines()
    made = {line: Path(line) for line in lines if line.endswith((".png", ".svg", ".html"))}
    pictures = [file for file in made.values() if file.suffix == ".png"]
    if not pictures:
        raise RuntimeError(f"{path.name} printed no path of a PNG: the gallery has no picture")
    pages = [file for file in made.values() if file.suffix == ".html" and file.name != "index.html"]
    told = "\n".join(line for line in lines if line not in made)
    # as the command on its page has it, not where this machine keeps it
    return Story(path, pictures, pages, told.replace(str(pictures[0].parent), SHOWN))


def picture(told, file, up=""):
    """A picture with its alternative text, as Markdown of a page in docs, or `up` from there."""
    return f"![{told.summary}]({up}_generated/examples/{file.name})"


def runs(told, up=""):
    """Links to the pages of its runs. They are no documents of Sphinx, so these are HTML."""
    links = []
    for file in told.pages:
        which = variant(told, file)
        href = f"{up}runs/examples/{file.name}"
        links.append(f'<a class="run" href="{href}">Watch {which or "it move"}</a>')
    return " · ".join(links)


def variant(told, file):
    """What the name of a page has beyond that of the first picture, such as its arm, or ""."""
    return file.stem.removeprefix(told.pictures[0].stem).replace("_", " ").strip()


def card(told):
    """What the gallery shows of an example, as Markdown of docs/gallery.md."""
    shown = told.robot or told.pictures[0]
    return (
        f"::::{{container}} example\n{picture(told, shown)}\n\n"
        f"[{told.title}](gallery/{told.path.stem}.md)\n\n"
        f"{told.summary}\n\n{runs(told)}\n::::\n"
    )


def cards(stories):
    """All of them."""
    return ":::::{container} gallery\n" + "".join(map(card, stories)) + ":::::\n"


def page(told):
    """The page of an example, as Markdown of docs/gallery/."""
    shown = [*told.pictures, *filter(None, [told.robot])]
    pictures = "\n\n".join(picture(told, file, "../") for file in shown)
    return f"""---
hide-toc: true
---

# {told.title}

{told.summary}

{pictures}

{told.text}

{runs(told, "../")}

```sh
{told.commands}
```

When this site was built, it printed:

```text
{told.printed}
```

## Source

```{{literalinclude}} ../../examples/{told.path.name}
:language: python
:class: example-source
```
"""


def write(docs, stories):
    """Write the cards and the pages below a folder of documents."""
    (docs / "_generated").mkdir(exist_ok=True)
    (docs / "_generated" / "gallery.md").write_text(cards(stories), encoding="utf-8")
    folder = docs / "gallery"
    shutil.rmtree(folder, ignore_errors=True)  # an example may have another name now
    folder.mkdir()
    for told in stories:
        (folder / f"{told.path.stem}.md").write_text(page(told), encoding="utf-8")


def with_robots(stories, out):
    """The same stories with a picture of each robot on its way."""
    try:
        from playwright.sync_api import Error
    except ImportError:
        return stories
    try:
        with opened(CARD, alone=True) as open_:
            return [with_robot(told, open_, out) for told in stories]
    except Error as error:  # there is no browser
        logging.getLogger(__name__).warning("The gallery shows no robots: %s", error)
        return stories


def with_robot(told, open_, out):
    """A story with a picture of its robot, if it has a page that shows it."""
    if not told.pages:
        return told
    robot = out / f"{told.path.stem}_robot.webp"
    shown = open_(out / told.pages[0].name)
    shown.add_style_tag(content="header { display: none }")  # too small to be read on a card
    save(at(shown, MOMENT * shown.evaluate("approxjac.column('t').at(-1)[0]")), robot)
    return replace(told, robot=robot)


def make(app):
    docs = Path(app.srcdir)
    out = docs / "_generated" / "examples"
    shutil.rmtree(out, ignore_errors=True)
    results = os.environ.get("APPROXJAC_RESULTS")
    folder = Path(results, "examples") if results else None
    stories = [left(path, folder, out) if folder else run(path, out) for path in examples()]
    write(docs, with_robots(stories, out))
    write_index(out, "Runs of the examples")  # those that examples wrote know only their own
    gather(out, docs / "_generated" / "site" / "runs" / "examples")


def setup(app):
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
