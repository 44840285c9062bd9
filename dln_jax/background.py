"""Work in a background thread: XLA releases the interpreter lock while it compiles or runs."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")


def in_background(
    function: Callable[Arguments, Result], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Callable[[], Result]:
    """Starts `function(*arguments, **options)` in a thread.

    Returns:
        A function that waits for the result and returns it, or raises the exception of `function`.
    """
    thread = ThreadPoolExecutor(1)
    future = thread.submit(function, *arguments, **options)
    thread.shutdown(wait=False)
    return future.result
