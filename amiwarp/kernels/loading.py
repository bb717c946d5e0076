"""Kernels compiled and loaded: generic ones for the models in use, one module at a time, or all ahead."""

import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, partial
from threading import Lock, Thread, get_ident, main_thread
from typing import Any

import warp as wp

from amiwarp.tasks import Progress, in_order, silent
from amiwarp.workarounds import compiled_headers

_specialising = Lock()
_loading: defaultdict[str, Lock] = defaultdict(Lock)
_loaded: set[tuple[str, str]] = set()
"""Names of the modules that are loaded, each with its device."""
_header: list[Any] = []
"""Folder of the header that Warp precompiled for CPUs, or empty before the first compilation."""
_heading = Lock()


def specialised(kernel: Any, inputs: Sequence[Any]) -> Any:
    """Return a generic kernel for the structs among its inputs, alone in a module; return any other kernel as it is.

    So only the optical models that are used are compiled, and a new one does not compile the others again.
    """
    generic = _generic_arguments(kernel)
    if not generic:
        return kernel
    # The type of a struct, or of the elements of an array of structs.
    structs = tuple(getattr(inputs[k], "_cls", None) or inputs[k].dtype for k in generic)
    with _specialising:
        return _specialised(kernel, structs)


@cache
def _generic_arguments(kernel: Any) -> dict[int, Any]:
    """Return a kernel's generic arguments by their positions: structs, and arrays of structs.

    A kernel that has overloads already is not generic.
    """
    if kernel.overloads:
        return {}
    return {
        k: argument
        for k, argument in enumerate(kernel.adj.args)
        if Any in (argument.type, getattr(argument.type, "dtype", None))
    }


@cache
def _specialised(kernel: Any, structs: tuple[Any, ...]) -> Any:
    """Return a generic kernel for the structs in the order of its generic arguments."""
    name = ".".join([kernel.module.name, kernel.key, *(struct.key for struct in structs)])
    module = wp.get_module(name)
    module.options.update(kernel.module.options)
    types = {
        argument.label: struct if argument.type is Any else wp.array(dtype=struct)
        for argument, struct in zip(_generic_arguments(kernel).values(), structs, strict=True)
    }
    bounds = kernel.options.get("launch_bounds")
    return wp.overload(wp.kernel(kernel.func, module=module, launch_bounds=bounds), types)


def load(kernel: Any, device: Any) -> None:
    """Compile and load a kernel's module with the block size that launches here use, at the first call.

    Call it before several threads launch the kernel, or each of them would try to compile it. A call waits for a
    running one for the same module.
    """
    name = (kernel.module.name, device.alias)
    if name in _loaded:
        return
    with _loading[kernel.module.name]:
        if not device.is_cpu or _has_header():
            kernel.module.load(device, block_dim=1 if device.is_cpu else None)
        else:
            with _heading:
                _has_header()
                kernel.module.load(device, block_dim=1)
                if get_ident() in compiled_headers():
                    _header.append(compiled_headers()[get_ident()])
        _loaded.add(name)


def _has_header() -> bool:
    """Give this thread the header that the first one to compile made, which takes three seconds, if there is one."""
    if _header:
        compiled_headers().setdefault(get_ident(), _header[0])
    return bool(_header)


def load_kernels(kernels: Iterable[tuple[Any, ...]], device: Any) -> None:
    """Compile and load kernels. Each is followed by the structs of its generic arguments.

    A module that another thread is loading is left to that thread.
    """
    for kernel, *structs in kernels:
        with _specialising:
            one = _specialised(kernel, tuple(structs)) if structs else kernel
        if not _loading[one.module.name].locked():
            load(one, wp.get_device(device))


def load_ahead(kernels: Iterable[tuple[Any, ...]], device: Any) -> None:
    """Compile and load kernels as :func:`load_kernels` does, in the background, until the program ends."""
    # Before the threads start, or each of them would initialise Warp.
    device = wp.get_device(device)
    left = iter(kernels)
    taking = Lock()

    def wanted() -> Iterator[tuple[Any, ...]]:
        while main_thread().is_alive():
            with taking:
                one = next(left, None)
            if one is None:
                return
            yield one

    for k in range(2):
        Thread(target=load_kernels, args=(wanted(), device), name=f"amiwarp-compiler-{k}").start()


def load_all(device: Any, progress: Progress = silent) -> None:
    """Compile and load the kernels of all imported modules, several at a time, except those for one optical model.

    Processes that start later find them in Warp's cache. Processes that start together would all compile them.
    """
    names = [name for name in list(sys.modules) if name.startswith(f"{__package__}.")]
    kernels = {}  # one of each module
    for name in names:
        for value in vars(sys.modules[name]).values():
            if isinstance(value, wp.Kernel) and not _generic_arguments(value):
                kernels[value.module.name] = value
    jobs = [partial(load, kernel, wp.get_device(device)) for kernel in kernels.values()]
    for k, _ in enumerate(in_order(jobs)):
        progress("compiling kernels", (k + 1) / len(jobs))
