"""Tasks on a cluster of dask.distributed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import click

from eschorty_ros.core.base.errors import DeviceError, EschortyError

_CONNECT_S = 30


def on_cluster(
    address: str, task: Callable[..., Any], calls: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[int, Any]]:
    """Yield the index and the result of each call of ``task``, or its exception, as they end.

    The workers have this package and see the same files.

    Raises ``EschortyError`` when dask.distributed is not installed. Raises ``DeviceError`` when no
    scheduler answers at ``address``.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise EschortyError(
            "--dask needs dask.distributed; install it by `pip install distributed`"
        ) from error
    click.echo(f"connecting to {address}, for up to {_CONNECT_S} s", err=True)
    try:
        # A client that finds no scheduler would wait for it once more when it is deleted.
        asyncio.run(_reach(address))
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"no dask scheduler answers at {address}; start one by `dask scheduler`"
        ) from error
    with client:
        # Two calls with the same arguments are two tasks; none is retried: it would write again.
        index = {
            client.submit(task, *call, pure=False, retries=0): k for k, call in enumerate(calls)
        }
        for done in as_completed(index, loop=client.loop):
            failure = done.exception()
            yield index[done], done.result() if failure is None else failure


async def _reach(address: str) -> None:
    from distributed.comm import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")
    comm = await connect(address, timeout=_CONNECT_S, **arguments)
    await comm.close()
