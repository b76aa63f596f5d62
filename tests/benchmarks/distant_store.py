"""An S3 server for measuring: objects in memory, each answer after a while, next to no CPU time.

`python -m tests.benchmarks.distant_store MILLISECONDS` prints its address and serves until it is ended. It has what the
object store of sweeps asks for (GET, HEAD, PUT with conditions, lists, deletion of one and of many), and knows nothing
of signatures. `GET /-/requests` tells how many requests of each method came so far, as JSON.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
import json
import re
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import format_datetime
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape, unescape

_PAGE = 1_000
REQUESTS = "/-/requests"
"""No bucket's path."""


@dataclass(frozen=True)
class _Object:
    data: bytes
    tag: str
    modified: datetime


Answer = tuple[int, Mapping[str, str], bytes]


class Store:
    """The objects by bucket and key, and what is answered."""

    def __init__(self) -> None:
        self.objects: dict[str, _Object] = {}
        self.num_requests: Counter[str] = Counter()

    def requests(self) -> Answer:
        """Tell how many requests came."""
        return 200, {"Content-Type": "application/json"}, json.dumps(self.num_requests).encode()

    def answer(self, method: str, target: str, headers: Mapping[str, str], body: bytes) -> Answer:
        """Return status, headers and body for a request."""
        parts = urlsplit(target)
        self.num_requests[method] += 1
        query = {name: values[0] for name, values in parse_qs(parts.query, keep_blank_values=True).items()}
        path = unquote(parts.path).lstrip("/")
        if method == "GET" and "list-type" in query:
            return self._list(path.rstrip("/"), query)
        if method == "POST" and "delete" in query:
            keys = [unescape(key) for key in re.findall(r"<Key>(.*?)</Key>", body.decode())]
            for key in keys:
                self.objects.pop(f"{path.rstrip('/')}/{key}", None)
            done = "".join(f"<Deleted><Key>{escape(key)}</Key></Deleted>" for key in keys)
            return 200, {"Content-Type": "application/xml"}, f"<DeleteResult>{done}</DeleteResult>".encode()
        if method == "DELETE":
            self.objects.pop(path, None)
            return 204, {}, b""
        known = self.objects.get(path)
        if method == "PUT":
            return self._put(path, known, headers, body)
        if known is None:
            return 404, {}, b"<Error><Code>NoSuchKey</Code></Error>"
        told = {"ETag": known.tag, "Last-Modified": format_datetime(known.modified, usegmt=True)}
        return 200, told, known.data

    def _put(self, path: str, known: _Object | None, headers: Mapping[str, str], body: bytes) -> Answer:
        wanted = headers.get("if-match")
        if (wanted is not None and (known is None or known.tag != wanted)) or (
            headers.get("if-none-match") == "*" and known is not None
        ):
            return 412, {}, b"<Error><Code>PreconditionFailed</Code></Error>"
        tag = f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}"'
        self.objects[path] = _Object(body, tag, datetime.now(UTC))
        return 200, {"ETag": tag}, b""

    def _list(self, bucket: str, query: Mapping[str, str]) -> Answer:
        prefix, delimiter = query.get("prefix", ""), query.get("delimiter", "")
        after = query.get("continuation-token", query.get("start-after", ""))
        found: dict[str, str] = {}
        for path in sorted(self.objects):
            name, _, key = path.partition("/")
            if name != bucket or not key.startswith(prefix):
                continue
            rest = key.removeprefix(prefix)
            if delimiter and delimiter in rest:
                folder = prefix + rest.partition(delimiter)[0] + delimiter
                found[folder] = f"<CommonPrefixes><Prefix>{escape(folder)}</Prefix></CommonPrefixes>"
            else:
                item = self.objects[path]
                found[key] = (
                    f"<Contents><Key>{escape(key)}</Key><LastModified>{item.modified:%Y-%m-%dT%H:%M:%S.000Z}"
                    f"</LastModified><ETag>{escape(item.tag)}</ETag><Size>{len(item.data)}</Size></Contents>"
                )
        names = sorted(name for name in found if name > after)
        page, more = names[:_PAGE], len(names) > _PAGE
        token = f"<NextContinuationToken>{escape(page[-1])}</NextContinuationToken>" if more else ""
        text = "".join(found[name] for name in page)
        body = f"<ListBucketResult><IsTruncated>{str(more).lower()}</IsTruncated>{token}{text}</ListBucketResult>"
        return 200, {"Content-Type": "application/xml"}, body.encode()


async def _serve(store: Store, delay_s: float, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while head := await _head(reader):
        first, *lines = head.decode("latin-1").split("\r\n")
        method, target, _ = first.split(" ", 2)
        headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        body = await reader.readexactly(int(headers.get("content-length", 0)))
        if target == REQUESTS:
            status, told, data = store.requests()
        else:
            status, told, data = store.answer(method, target, headers, body)
            await asyncio.sleep(delay_s)
        answered = {**told, "Content-Length": str(len(data))}
        text = "".join(f"{name}: {value}\r\n" for name, value in answered.items())
        writer.write(f"HTTP/1.1 {status} .\r\n{text}\r\n".encode() + (b"" if method == "HEAD" else data))
        await writer.drain()
    writer.close()


async def _head(reader: asyncio.StreamReader) -> bytes:
    try:
        return (await reader.readuntil(b"\r\n\r\n"))[:-4]
    except (asyncio.IncompleteReadError, ConnectionError):
        return b""


async def _main(delay_s: float) -> None:
    store = Store()
    server = await asyncio.start_server(functools.partial(_serve, store, delay_s), "127.0.0.1", 0)
    print(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    async with server:
        await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(_main(float(sys.argv[1]) / 1e3))
