"""Local OpenAI-compatible server with scripted replies."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import log


@dataclass
class Server:
    """Scripted server and the requests that it received.

    The replies are used in order; the last one repeats. Each writes to the handler.
    """

    url: str = ""
    replies: list[Callable[[BaseHTTPRequestHandler], None]] = field(default_factory=list)
    requests: list[dict] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)  # Ends replies that hang.

    def next_reply(self) -> Callable[[BaseHTTPRequestHandler], None]:
        return self.replies.pop(0) if len(self.replies) > 1 else self.replies[0]


@contextmanager
def serving(*replies: Callable[[BaseHTTPRequestHandler], None]) -> Iterator[Server]:
    server = Server(replies=list(replies))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            server.requests.append(json.loads(self.rfile.read(length)))
            server.paths.append(self.path)
            server.keys.append(self.headers["Authorization"])
            self.ended, self.payload = server.ended, server.requests[-1]
            with suppress(OSError):  # The client may have disconnected.
                server.next_reply()(self)

        def log_message(self, *_arguments: object) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.daemon_threads = True
    server.url = f"http://127.0.0.1:{http.server_address[1]}/v1"
    thread = threading.Thread(target=http.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield server
    finally:
        server.ended.set()
        http.shutdown()
        thread.join()
        http.server_close()


def replies_with(text: str, *probabilities: float) -> Callable[[BaseHTTPRequestHandler], None]:
    """Return a reply with a chat completion.

    Args:
        text: Text of the completion.
        probabilities: Probability of each piece of the text; log-probabilities are absent if
            none is given.
    """
    message: dict = {"message": {"role": "assistant", "content": text}, "index": 0}
    if probabilities:
        size = -(-len(text) // len(probabilities))
        pieces = [text[k * size : (k + 1) * size] for k in range(len(probabilities))]
        content = [
            {"token": piece, "logprob": log(p), "top_logprobs": []}
            for piece, p in zip(pieces, probabilities, strict=True)
        ]
        content.append({"token": "<|im_end|>", "logprob": log(0.01), "top_logprobs": []})
        message["logprobs"] = {"content": content}
    return responds(200, json.dumps({"object": "chat.completion", "choices": [message]}).encode())


def responds(status: int, body: bytes = b"{}") -> Callable[[BaseHTTPRequestHandler], None]:
    def reply(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        handler.wfile.write(body)

    return reply


def hangs(handler: BaseHTTPRequestHandler) -> None:
    handler.ended.wait()  # type: ignore[attr-defined]


def trickles(handler: BaseHTTPRequestHandler) -> None:
    """Send a byte every 20 ms without end, so no single read times out."""
    handler.send_response(200)
    handler.send_header("Content-Length", "1000000")
    handler.end_headers()
    while not handler.ended.wait(0.02):  # type: ignore[attr-defined]
        handler.wfile.write(b" ")
        handler.wfile.flush()


def trickles_headers(handler: BaseHTTPRequestHandler) -> None:
    """Send a header line every 20 ms without end."""
    handler.send_response(200)
    while not handler.ended.wait(0.02):  # type: ignore[attr-defined]
        handler.send_header("X-More", "to come")
        handler.flush_headers()


def cuts_off(handler: BaseHTTPRequestHandler) -> None:
    """Send a whole completion that is shorter than announced."""
    body = b'{"choices": [{"message": {"content": "sofa"}}]}'
    handler.send_response(200)
    handler.send_header("Content-Length", str(len(body) + 10))
    handler.end_headers()
    handler.wfile.write(body)
    handler.close_connection = True


def redirects(url: str) -> Callable[[BaseHTTPRequestHandler], None]:
    """Return a reply that redirects the request to another server."""

    def reply(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(307)
        handler.send_header("Location", url)
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    return reply


def hangs_up(handler: BaseHTTPRequestHandler) -> None:
    handler.close_connection = True
