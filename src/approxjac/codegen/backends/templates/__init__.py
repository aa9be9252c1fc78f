"""Templates: the code around the lines of a program."""

from importlib import resources


def template(name: str) -> str:
    """Return the text of a file, in which $names are to be filled in."""
    return (resources.files(__name__) / f"{name}.in").read_text(encoding="utf-8")
