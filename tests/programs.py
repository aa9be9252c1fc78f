"""Runs Python files as programs of their own, forked from one that has loaded what takes long."""

import atexit
import functools
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory


def run_python(*words):
    """Run `python` with these words; return its exit code and what it wrote to both streams.

    They are a file or `-m` and a module, and arguments.
    """
    with TemporaryDirectory() as folder:
        streams = [Path(folder, name) for name in ("out", "err")]
        request = {
            "words": [str(word) for word in words], "streams": [str(each) for each in streams],
            "folder": os.getcwd(), "environment": dict(os.environ),
        }  # fmt: skip
        print(json.dumps(request), file=_server().stdin, flush=True)
        code = int(_server().stdout.readline())
        return code, *(stream.read_text(encoding="utf-8") for stream in streams)


@functools.cache
def _server():
    pipe = subprocess.PIPE
    server = subprocess.Popen([sys.executable, __file__], stdin=pipe, stdout=pipe, text=True)
    atexit.register(server.communicate)  # which ends it
    return server


def _serve():
    """Run what is asked for, and answer with its exit code."""
    import cv2  # noqa: F401
    import daqp  # noqa: F401
    import llvmlite.binding  # noqa: F401
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg
    import matplotlib.pyplot  # noqa: F401
    import meshcat  # noqa: F401
    import scipy.optimize  # noqa: F401

    import approxjac as aj
    import approxjac.cli
    import approxjac.view
    from approxjac.view.look import robot_look

    robot_look(aj.load_robot("panda"))  # simplifying its meshes takes a second and a half
    for line in sys.stdin:
        child = os.fork()
        if not child:
            _run(**json.loads(line))
            return
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _run(words, streams, folder, environment):
    for number, path in enumerate((os.devnull, *streams)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    if words[0] == "-m":
        sys.argv[:], sys.path[0] = words[1:], folder
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv[:], sys.path[0] = words, str(Path(words[0]).parent)
        runpy.run_path(words[0], run_name="__main__")


if __name__ == "__main__":
    _serve()
