"""Shows the running task with tqdm on standard error, if it takes longer than a second."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import Any

import jax


INTERVAL = 1.0  # seconds until a task is shown, and between updates
COMPILING = (
    "/jax/core/compile/backend_compile_duration"  # JAX's event: a scalar at its begin, a duration at its end
)


@contextmanager
def every_second(tell: Callable[[float], object]) -> Iterator[None]:
    """Call a function once a second, in another thread, with the seconds since the block began."""
    begun, ended = time.monotonic(), threading.Event()

    def run() -> None:
        while not ended.wait(INTERVAL):
            tell(time.monotonic() - begun)

    thread = threading.Thread(target=run, daemon=True, name="jaxvol progress")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@cache  # JAX 0.8 forgets no listener
def _compiled_now() -> list[str]:
    """List of the programs being compiled, updated from now on."""
    names: list[str] = []

    def begin(event: str, value: float | int, **about: Any) -> None:
        if event == COMPILING:
            names.append(str(about.get("fun_name", "")).removeprefix("jit").strip("(_)").replace("_", " "))

    def end(event: str, duration_secs: float, **about: Any) -> None:
        if event == COMPILING and names:
            names.pop()

    jax.monitoring.register_scalar_listener(begin)
    jax.monitoring.register_event_duration_secs_listener(end)
    return names


@contextmanager
def progress(task: str, total: int | None = None, *, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """Show a task, and the program being compiled, if it takes longer than a second: in a terminal or a
    notebook, unless `quiet`. With a `total` of steps, a bar shows the finished ones. The context's value is
    the function to call after each step, with a note to show beside the bar, or without."""
    from tqdm import tqdm

    kernel = "ipykernel" in sys.modules
    if kernel and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm
    form: dict[str, Any] = {"bar_format": "{desc}: {elapsed}"} if total is None else {}
    disable = quiet or not (kernel or sys.stderr.isatty())
    with tqdm(desc=task, total=total, delay=INTERVAL, disable=disable, leave=False, **form) as bar:

        def done(note: str = "") -> None:
            bar.set_postfix_str(note, refresh=False)
            bar.update()

        if disable:
            yield done
            return
        programs = _compiled_now()

        def tell(seconds: float) -> None:
            bar.last_print_t = time.time()  # else a bar with a delay is not cleared at the end
            bar.set_description_str(f"{task}, compiling {programs[-1]}" if programs else task)

        with every_second(tell):
            yield done
