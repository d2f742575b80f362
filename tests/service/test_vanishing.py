"""Clients that go away are nobody's failure: no traceback, no 500, nothing held."""

from __future__ import annotations

import asyncio
import logging
import re
import socket

import pytest

from deepshade_service.workers import unless

HEAD = (
    "POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/x-exr\r\n"
    "Content-Length: {length}\r\n\r\n"
)


@pytest.mark.parametrize("path", ["/shade/ao", "/environments/new"])
def test_a_client_that_leaves_in_the_middle_of_its_body(
    start, make_exr, wait_until, caplog, tmp_path, path
):
    service = start(environments=tmp_path, environment_uploads=True)
    body = make_exr(64, 64)
    route = re.escape("/shade/{effect}" if "shade" in path else "/environments/{name}")
    head = HEAD.format(path=path, length=len(body))

    def gone() -> int:
        text = service.client.get("/metrics").text
        found = dict(re.findall(rf'total{{route="{route}",status="(\d+)"}} (\d+)\.0\n', text))
        assert not [status for status in found if status[0] == "5"]
        return int(found.get("499", 0))

    with caplog.at_level(logging.WARNING):
        for sent in (1, len(body) // 2, len(body) - 1):
            before = gone()
            with socket.create_connection(service.address, timeout=10) as connection:
                connection.sendall(head.encode() + body[:sent])
            wait_until(lambda before=before: gone() == before + 1)
    assert not caplog.records
    wait_until(lambda: service.service.uploads.held == 0)
    assert service.client.post(
        "/shade/ao", content=body, headers={"Content-Type": "image/x-exr"}
    ).is_success


def test_a_cancellation_while_others_are_cancelled_is_not_lost() -> None:
    """Else who waits for the cancelled one, as a service that stops, waits for ever."""

    async def main() -> bool:
        ending = asyncio.Event()

        async def slow_to_end() -> None:
            try:
                await asyncio.sleep(60)
            finally:
                ending.set()
                await asyncio.sleep(0.01)

        async def quick() -> int:
            await asyncio.sleep(0)
            return 1

        task = asyncio.ensure_future(unless(slow_to_end(), ValueError(), quick()))
        await ending.wait()
        task.cancel()
        await asyncio.wait([task])
        return task.cancelled()

    assert asyncio.run(main())
