"""Linear algebra on one thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def use_one_thread() -> threadpool_limits:
    """Restrict the linear algebra of this process to one thread, until the returned context ends, if it is one.

    The matrices of an arm are small. Shared among threads they take several times as long as on one, since the threads
    wait for each other, and all the longer where other programs run beside them.
    """
    return threadpool_limits(1, user_api="blas")


def on_one_thread(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a function that is called from outside: its linear algebra runs on one thread."""

    @wraps(function)
    def on_one(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with use_one_thread():
            return function(*args, **kwargs)

    return on_one
