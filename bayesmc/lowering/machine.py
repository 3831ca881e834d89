"""Text to machine code by LLVM, through a cache of the user's own.

llvmlite is imported when something is compiled. Compiled objects lie in ``bayesmc/machine-code`` below the
user's cache directory (``XDG_CACHE_HOME``, else ``~/.cache``), which nobody else may enter; their names tell
the text, the compiler and the processor apart, and one that is not as it was written is ignored.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import stat
import tempfile
import warnings
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from bayesmc.errors import EngineWarning, TraceError
from bayesmc.lowering.kernel import DIRECT, ENTRY
from bayesmc.lowering.ufuncs import SCIPY

#: objects in the cache, beyond which the oldest half goes
MOST = 1000
_MARK = b"bayesmc machine code 1\n"


@lru_cache(maxsize=1)
def is_available() -> bool:
    """Whether there is a compiler, without importing it; one that does not load is found out at first use."""
    return importlib.util.find_spec("llvmlite") is not None


class Loaded:
    """Functions of machine code.

    Attributes
    ----------
    address : int
        Of ``int32 f(int64 entries, void** arguments)``.
    direct : int
        Of the function of the one leaf that varies; 0 if there is none.
    call : callable
        The same from Python.
    was_cached : bool
    """

    def __init__(self, code: bytes, was_cached: bool) -> None:
        binding, machine, _ = _compiler()
        empty = binding.parse_assembly("")
        self._engine = binding.create_mcjit_compiler(empty, machine())
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self.address: int = self._engine.get_function_address(ENTRY)
        self.direct: int = self._engine.get_function_address(DIRECT)
        self.call = self.function(ENTRY, ctypes.c_int32, ctypes.c_int64, ctypes.c_void_p)
        self.was_cached = was_cached

    def function(self, name: str, *types: Any) -> Any:
        """A function of the code, of these types: that of the result first."""
        return ctypes.CFUNCTYPE(*types)(self._engine.get_function_address(name))


@lru_cache(maxsize=128)
def loaded(text: str, foreign: tuple[str, ...]) -> Loaded:
    """Machine code of a text, from the cache if it is there.

    Parameters
    ----------
    text : str
    foreign : tuple of str
        Functions that it calls and does not define.

    Raises
    ------
    ImportError
        There is no llvmlite.
    """
    binding, _, _ = _compiler()
    for name in foreign:
        if name.startswith(SCIPY):
            binding.add_symbol(name, _scipy_address(name.removeprefix(SCIPY)))
    key = _key(text)
    code = read(key)
    if code is not None:
        with suppress(RuntimeError):
            return Loaded(code, True)
    code = _compiled(text)
    write(key, code)
    return Loaded(code, False)


def is_kept(text: str) -> bool:
    """Whether machine code of a text is in the cache."""
    return read(_key(text)) is not None


def read(key: str) -> bytes | None:
    """An object of the cache; None where there is none, or not as it was written."""
    folder = _folder(make=False)
    if folder is None:
        return None
    try:
        content = (folder / key).read_bytes()
    except OSError:
        return None
    head = len(_MARK) + 32
    mark, told, code = content[: len(_MARK)], content[len(_MARK) : head], content[head:]
    return code if mark == _MARK and told == hashlib.sha256(key.encode() + code).digest() else None


def write(key: str, code: bytes) -> None:
    """An object into the cache, all or nothing; without a folder for it, nothing."""
    folder = _folder(make=True)
    if folder is None:
        return
    content = _MARK + hashlib.sha256(key.encode() + code).digest() + code
    try:
        handle, name = tempfile.mkstemp(dir=folder, prefix=".new-")
    except OSError:
        return
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, folder / key)
    except OSError:
        with suppress(OSError):
            os.unlink(name)
    _tidy(folder)


# ---- private ------------------------------------------------------------------------------------


def _key(text: str) -> str:
    """The name of a text's object in the cache."""
    return hashlib.sha256(f"{_compiler()[2]}\n{text}".encode()).hexdigest()


def _folder(make: bool) -> Path | None:
    """The cache's folder, if it belongs to the user alone."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
        folder = root / "bayesmc" / "machine-code"
        if make:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except (OSError, RuntimeError):
        return None
    if not stat.S_ISDIR(found.st_mode):
        return None
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    is_private = os.name != "posix" or not found.st_mode & 0o077
    return folder if is_own and is_private else None


def _tidy(folder: Path) -> None:
    with suppress(OSError):
        files = list(folder.iterdir())
        if len(files) > MOST:
            files.sort(key=lambda f: f.stat().st_mtime)
            for old in files[: len(files) // 2]:
                old.unlink(missing_ok=True)


@lru_cache(maxsize=1)
def _compiler() -> tuple[Any, Any, str]:
    """llvmlite, what makes a target machine, and what tells this compiler and processor from others.

    Raises
    ------
    TraceError
        It is there, but does not load.
    """
    try:
        import llvmlite
        from llvmlite import binding
    except (ImportError, OSError, RuntimeError) as error:
        why = f"llvmlite is installed, but does not load ({type(error).__name__}: {error})"
        _warn_once(why)
        raise TraceError(why) from None

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    cpu, features = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    target = binding.Target.from_default_triple()

    def machine() -> Any:
        return target.create_target_machine(
            cpu=cpu, features=features, opt=3, codemodel="jitdefault"
        )

    version = ".".join(map(str, binding.llvm_version_info))
    identity = f"{llvmlite.__version__} {version} {target.triple} {cpu} {features}"
    return binding, machine, identity


@lru_cache(maxsize=1)
def _warn_once(why: str) -> None:
    warnings.warn(
        f"{why}: NumPy does the work of machine code; reinstall llvmlite, or uninstall it",
        EngineWarning,
        stacklevel=2,
    )


def _compiled(text: str) -> bytes:
    binding, machine, _ = _compiler()
    module = binding.parse_assembly(text)
    target = machine()
    module.triple, module.data_layout = target.triple, str(target.target_data)
    options = binding.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = True
    builder = binding.create_pass_builder(target, options)
    builder.getModulePassManager().run(module, builder)
    return target.emit_object(module)


def _scipy_address(name: str) -> int:
    """Where a function of ``scipy.special`` lies, as SciPy hands it to Cython."""
    from scipy.special import cython_special

    capsule = cython_special.__pyx_capi__[name]
    api = ctypes.pythonapi
    name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", api))
    pointer_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
        ("PyCapsule_GetPointer", api)
    )
    signature = name_of(capsule)
    if not signature.startswith(b"double (double"):
        raise ImportError(f"scipy.special.cython_special.{name} is {signature!r}")
    return pointer_of(capsule, signature)
