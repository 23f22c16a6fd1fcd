"""An OpenAI-compatible server on this machine that behaves as a test tells it."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import log


@dataclass
class Server:
    """`answers` are used up in order, the last one for ever; each writes to the handler."""

    url: str = ""
    answers: list[Callable[[BaseHTTPRequestHandler], None]] = field(default_factory=list)
    asked: list[dict] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)  # who hangs, waits for it

    def next_answer(self) -> Callable[[BaseHTTPRequestHandler], None]:
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


@contextmanager
def serving(*answers: Callable[[BaseHTTPRequestHandler], None]) -> Iterator[Server]:
    server = Server(answers=list(answers))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            server.asked.append(json.loads(self.rfile.read(length)))
            server.paths.append(self.path)
            server.keys.append(self.headers["Authorization"])
            self.over, self.question = server.over, server.asked[-1]
            with suppress(OSError):  # who asked has left
                server.next_answer()(self)

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
        server.over.set()
        http.shutdown()
        thread.join()
        http.server_close()


def says(text: str, *probabilities: float) -> Callable[[BaseHTTPRequestHandler], None]:
    """A completion; a probability for each piece of the text, none: no log-probabilities."""
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
    return sends(200, json.dumps({"object": "chat.completion", "choices": [message]}).encode())


def sends(status: int, body: bytes = b"{}") -> Callable[[BaseHTTPRequestHandler], None]:
    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        handler.wfile.write(body)

    return answer


def hangs(handler: BaseHTTPRequestHandler) -> None:
    handler.over.wait()  # type: ignore[attr-defined]


def trickles(handler: BaseHTTPRequestHandler) -> None:
    """A byte now and then, so that no read ever times out."""
    handler.send_response(200)
    handler.send_header("Content-Length", "1000000")
    handler.end_headers()
    while not handler.over.wait(0.02):  # type: ignore[attr-defined]
        handler.wfile.write(b" ")
        handler.wfile.flush()


def trickles_headers(handler: BaseHTTPRequestHandler) -> None:
    """A header line now and then, without end."""
    handler.send_response(200)
    while not handler.over.wait(0.02):  # type: ignore[attr-defined]
        handler.send_header("X-More", "to come")
        handler.flush_headers()


def breaks_off(handler: BaseHTTPRequestHandler) -> None:
    """Sends less than it announced, and a whole completion."""
    body = b'{"choices": [{"message": {"content": "sofa"}}]}'
    handler.send_response(200)
    handler.send_header("Content-Length", str(len(body) + 10))
    handler.end_headers()
    handler.wfile.write(body)
    handler.close_connection = True


def redirects(url: str) -> Callable[[BaseHTTPRequestHandler], None]:
    """To another server, with the question."""

    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(307)
        handler.send_header("Location", url)
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    return answer


def hangs_up(handler: BaseHTTPRequestHandler) -> None:
    handler.close_connection = True
