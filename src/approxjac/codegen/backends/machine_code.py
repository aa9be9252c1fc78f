"""Machine code of a text in LLVM's language, cached for later use.

The key of the cache is the text, the processor, and the versions of this library and of llvmlite.
Code is cached in memory and in a folder `approxjac` among the user's caches, or the folder in the
environment variable APPROXJAC_CACHE; "0" or "off" is no folder. Files are written atomically and
have a digest: a damaged one is compiled again.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any, ClassVar

from approxjac.errors import package_of
from approxjac.files import replaced

_IN_MEMORY = 32  # programs
_ON_DISK = 256 * 2**20  # bytes of all
_SHORT = 600_000  # characters of a text, which is made faster in little time
_SWITCH = "APPROXJAC_CACHE"
_OFF = ("", "0", "off", "no", "false")


class MachineCode:
    """The function `run` of a text, at an `address`, which lives as long as this does."""

    _known: ClassVar[OrderedDict[str, MachineCode]] = OrderedDict()
    _lock: ClassVar[Any] = threading.RLock()

    def __init__(self, llvm: Any, machine: Any, code: bytes) -> None:
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self.address: int = self._engine.get_function_address("run")
        if not self.address:
            raise RuntimeError("machine code has no function run")

    @classmethod
    def of(cls, text: str, features: str, effort: int = 1) -> MachineCode:
        """Return the code of a text, for this processor with some of its features.

        With `effort` 0 it compiles ten times as fast, and runs a few times as long.

        Raises:
            MissingPackageError: llvmlite is not installed.
        """
        llvm = package_of("fast", "llvmlite.binding")
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        name = _digest(llvm, text, features, effort)
        with cls._lock:  # LLVM is no faster in several threads, and all may want the same
            if name in cls._known:
                cls._known.move_to_end(name)
                return cls._known[name]
            machine = llvm.Target.from_default_triple().create_target_machine(
                cpu=llvm.get_host_cpu_name(), features=features, opt=effort, jit=True
            )
            code = cls._known[name] = cls(llvm, machine, _made(llvm, machine, name, text, effort))
            while len(cls._known) > _IN_MEMORY:
                cls._known.popitem(last=False)
        return code


def _made(llvm: Any, machine: Any, name: str, text: str, effort: int) -> bytes:
    """Return the code of a text, from the cache if it is there, else compiled."""
    folder = cache_folder()
    path = None if folder is None else folder / f"{name}.code"
    if path is not None and (code := _read(path)) is not None:
        return code
    code = _compiled(llvm, machine, text, effort)
    if path is not None:
        _write(path, code)
    return code


def _compiled(llvm: Any, machine: Any, text: str, effort: int) -> bytes:
    module = llvm.parse_assembly(text)
    if effort and len(text) < _SHORT:  # like operations become one of vectors, with the same bits
        options = llvm.create_pipeline_tuning_options(speed_level=1)
        options.slp_vectorization, options.loop_vectorization = True, False
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


def cache_folder() -> Path | None:
    """Return the folder of the cache, or None."""
    chosen = os.environ.get(_SWITCH)
    if chosen is not None:
        return None if chosen.strip().lower() in _OFF else Path(chosen).expanduser()
    try:
        own = Path(os.environ.get("XDG_CACHE_HOME", ""))
        base = own if own.is_absolute() else Path.home() / ".cache"
    except RuntimeError:  # there is no home
        return None
    return base / "approxjac"


def _digest(llvm: Any, text: str, features: str, effort: int) -> str:
    import llvmlite

    import approxjac

    parts = (
        approxjac.__version__, llvmlite.__version__, str(llvm.llvm_version_info),
        llvm.get_default_triple(), llvm.get_host_cpu_name(), features, str(effort), text,
    )  # fmt: skip
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _read(path: Path) -> bytes | None:
    try:
        with path.open("rb") as file:
            data = file.read(_ON_DISK)
        code = data[hashlib.sha256().digest_size :]
        if data != _signed(path, code) + code:
            return None
        os.utime(path)  # the next to go is the one that was not used for longest
    except OSError:
        return None
    return code


def _write(path: Path, code: bytes) -> None:
    """Write code to the cache; if that fails, it is compiled again next time."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with replaced(path) as unfinished:
            unfinished.write_bytes(_signed(path, code) + code)
        files = [(each.stat().st_mtime, each) for each in path.parent.glob("*.code")]
        left = _ON_DISK
        for _, each in sorted(files, reverse=True):
            left -= each.stat().st_size
            if left < 0:
                each.unlink(missing_ok=True)
    except OSError:
        pass


def _signed(path: Path, code: bytes) -> bytes:
    """Return a digest of code and its source, so that no file is taken for another."""
    return hashlib.sha256(path.stem.encode() + code).digest()
