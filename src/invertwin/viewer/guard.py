"""Access to the viewer: loopback only, or a token in the address; no page of another site."""

import http
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from invertwin.errors import InputError

LOOPBACK = "127.0.0.1"
_MIN_TOKEN_LENGTH = 16  # characters of a token
_TOKEN = re.compile(rf"[A-Za-z0-9_-]{{{_MIN_TOKEN_LENGTH},}}")
_patch_lock = threading.Lock()


class AccessGuard:
    """Answers 403 to whom nothing is to be shown.

    A browser that has come with the right token in the address gets a cookie, with which it opens
    the connection of the page. Pages of other sites are refused, since a browser would connect
    them to this machine too.

    Args:
        host: Where the viewer listens.
        token: In the address; None = nobody needs one.

    Raises:
        InputError: A host beyond loopback without a token, one that is no address of this machine,
            or a token that can be guessed.
    """

    def __init__(self, host: str, token: str | None = None) -> None:
        try:
            found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
            for family, kind, protocol, _, address in found[:1]:
                with socket.socket(family, kind, protocol) as probe:
                    probe.bind(address)
        except OSError as error:
            raise InputError(
                f"expected an address of this machine as host, got {host!r} ({error}); "
                "use 127.0.0.1"
            ) from None
        self._local = all(ipaddress.ip_address(str(x[4][0])).is_loopback for x in found)
        if not self._local and token is None:
            raise InputError(
                f"expected a token for the host {host}, which others can reach, got none; add "
                f"one, such as {secrets.token_urlsafe(16)}, or use 127.0.0.1"
            )
        if token is not None and not _TOKEN.fullmatch(token):
            raise InputError(
                f"expected a token of at least {_MIN_TOKEN_LENGTH} letters, digits, - or _, got "
                f"{len(token)} characters; use one such as {secrets.token_urlsafe(16)}"
            )
        self._token = token

    def admits(self, path: str, headers: Any, port: int) -> bool:
        """Return True if a request may be answered.

        Args:
            path: With the query.
            headers: Of the request.
            port: Where it came in.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or any(urlsplit(origin).netloc != hosts[0] for origin in origins):
            return False
        if self._token is None:
            # A name of a stranger's that points to this machine is no loopback address.
            return urlsplit(f"//{hosts[0]}").hostname in ("127.0.0.1", "localhost", "::1")
        given = parse_qs(urlsplit(path).query).get("token", [])
        cookies = SimpleCookie("; ".join(headers.get_all("Cookie")))
        given += [cookies[_cookie_name(port)].value] if _cookie_name(port) in cookies else []
        return any(secrets.compare_digest(x.encode(), self._token.encode()) for x in given)

    def wrap_handler(self, handler: Callable[..., Any]) -> Callable[..., Any]:
        """The answers of a server, for those who are admitted.

        Args:
            handler: What `websockets` takes as ``process_request``.
        """

        def handle_request(connection: Any, request: Any) -> Any:
            port = connection.local_address[1]
            if not self.admits(request.path, request.headers, port):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "wrong or missing token\n")
            response = handler(connection, request)
            if response is not None and self._token is not None:
                kept = f"{_cookie_name(port)}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Set-Cookie"] = kept
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"
            return response

        return handle_request


@contextmanager
def install_guard(guard: AccessGuard) -> Iterator[None]:
    """Servers that are started in the block ask the guard before they answer.

    viser has no place for one: it hands its answers straight to `websockets`.

    Args:
        guard: The guard.
    """
    import websockets.asyncio.server as server  # pyright: ignore[reportMissingImports]

    with _patch_lock:
        plain = server.serve

        def serve(*args: Any, process_request: Callable[..., Any], **given: Any) -> Any:
            return plain(*args, process_request=guard.wrap_handler(process_request), **given)

        server.serve = serve
        try:
            yield
        finally:
            server.serve = plain


def _cookie_name(port: int) -> str:
    return f"invertwin_{port}"
