"""An HTTP server with byte ranges and ETags on loopback, whose faults a test chooses."""

import hashlib
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass(slots=True)
class Store:
    """The objects of a server by path, and its faults.

    Attributes
    ----------
    drop_every : end the connection in the middle of every n-th answer; 0: never.
    with_etag : name the version of an object by its ETag; otherwise by its time.
    with_ranges : answer requests for ranges with the range.
    status : answer every request with this status.
    requests : the ranges that were asked for, "" for a request without one.
    """

    objects: dict[str, bytes] = field(default_factory=dict)
    drop_every: int = 0
    with_etag: bool = True
    with_ranges: bool = True
    status: int = 0
    requests: list[str] = field(default_factory=list)
    modified: dict[str, int] = field(default_factory=dict)
    address: str = ""

    def put(self, path: str, data: bytes) -> str:
        """Store an object, or replace it by a newer one; return its URL."""
        self.modified[path] = self.modified.get(path, 0) + 1
        self.objects[path] = data
        return f"{self.address}{path}"


@contextmanager
def serve_ranges() -> Iterator[Store]:
    """Yield the store of a server on loopback."""
    store = Store()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *arguments: object) -> None:
            pass

        def do_HEAD(self) -> None:
            self.answer(with_body=False)

        def do_GET(self) -> None:
            self.answer(with_body=True)

        def answer(self, with_body: bool) -> None:
            path = self.path.partition("?")[0]
            asked = self.headers.get("Range", "")
            store.requests.append(asked)
            data = store.objects.get(path)
            if store.status or data is None:
                self.end(store.status or 404, b"", {})
                return
            etag = f'"{hashlib.blake2b(data, digest_size=8).hexdigest()}"'
            if store.with_etag and self.headers.get("If-Match", etag) != etag:
                self.end(412, b"", {})
                return
            versions = {"ETag": etag} if store.with_etag else {}
            time = f"Mon, 23 Nov 2026 12:00:{store.modified[path]:02} GMT"
            headers = {**versions, "Last-Modified": time, "Accept-Ranges": "bytes"}
            match = re.fullmatch(r"bytes=(\d+)-(\d+)", asked) if store.with_ranges else None
            if match is None:
                self.end(200, data, headers, with_body)
                return
            low, high = int(match[1]), int(match[2])
            headers["Content-Range"] = f"bytes {low}-{high}/{len(data)}"
            self.end(206, data[low : high + 1], headers, with_body)

        def end(self, status: int, body: bytes, headers: dict[str, str], with_body: bool = True) -> None:
            is_dropped = store.drop_every and len(store.requests) % store.drop_every == 0
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if with_body:
                self.wfile.write(body[: len(body) // 2] if is_dropped else body)
            self.close_connection = self.close_connection or bool(is_dropped)

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *arguments: object) -> None:
            """Print nothing: clients end connections, too."""

    with Server(("127.0.0.1", 0), Handler) as server:
        store.address = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield store
        server.shutdown()
        thread.join()
