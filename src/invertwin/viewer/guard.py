"""Access to the viewer: loopback only, or a token in the address; no page of another site.

And what a client may say: the value of a control, a place, a click, each within its range.
"""

import http
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from invertwin.errors import InputError

LOOPBACK = "127.0.0.1"
_MIN_TOKEN_LENGTH = 16  # characters of a token
_TOKEN = re.compile(rf"[A-Za-z0-9_-]{{{_MIN_TOKEN_LENGTH},}}")
_HOST = re.compile(r"([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?")
_MAX_MESSAGE, _MAX_TEXT, _MAX_NUMBER = 2**16, 1000, 1e6  # bytes, characters, metres or pixels
_VECTORS = {"wxyz": 4, "screen_pos": 2}  # numbers of a message's lists; all others have three
_MESSAGES = ("ViewerCameraMessage", "TransformControlsUpdateMessage", "SceneNodeClickMessage")
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
        except (OSError, UnicodeError) as error:
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

        Raises:
            ValueError: A malformed request.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        plain = unquote(path).isprintable() and len(path) <= _MAX_TEXT
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]) or not plain:
            raise ValueError("expected one host and a plain path")
        if not {*origins} <= {f"http://{hosts[0]}", f"https://{hosts[0]}"}:
            return False
        if self._token is None:
            # A name of a stranger's that points to this machine is no loopback address.
            return hosts[0] in [f"{name}:{port}" for name in (LOOPBACK, "localhost", "[::1]")]
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
            try:
                if not self.admits(request.path, request.headers, port):
                    return connection.respond(http.HTTPStatus.FORBIDDEN, "wrong or missing token\n")
                response = handler(connection, request)
            except (ValueError, OSError, CookieError):  # OSError: of a name that no file can have
                return connection.respond(http.HTTPStatus.BAD_REQUEST, "malformed request\n")
            if response is not None and self._token is not None:
                kept = f"{_cookie_name(port)}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Set-Cookie"] = kept
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"
            return response

        return handle_request


def is_valid_message(raw: Any, controls: Mapping[str, Any]) -> bool:
    """Return True for a message of a client that viser may act on.

    viser sets whatever attribute of a control a client names, to whatever it says.

    Args:
        raw: As it came in.
        controls: Of the panel, by their identifiers.
    """
    import msgspec  # comes with viser

    # Text, or no message.
    with suppress(TypeError, ValueError, RecursionError, msgspec.DecodeError):
        match msgspec.msgpack.decode(raw):
            case {"type": "GuiUpdateMessage", "uuid": str(name), "updates": dict(new)}:
                return [*new] == ["value"] and _accepts(controls.get(name), new["value"])
            case {"type": kind, **rest}:
                return kind in _MESSAGES and all(_is_plain(*item) for item in rest.items())
    return False


def _accepts(control: Any, value: Any) -> bool:
    """Return True for a value within the range of a control."""
    if hasattr(control, "options"):
        return value in control.options
    if hasattr(control, "min"):
        return type(value) in (int, float) and control.min <= value <= control.max
    return type(value) is bool and type(getattr(control, "value", None)) is bool


def _is_plain(name: str, value: Any) -> bool:
    """Return True for a short text, a number of a usual size, or a vector as its name says."""
    if isinstance(value, str | None):
        return len(value or "") <= _MAX_TEXT
    wanted = _VECTORS.get(name, 3) if isinstance(value, list) else 1
    numbers = value if isinstance(value, list) else [value]
    # Comparisons with NaN are false.
    usual = [type(x) in (int, float) and abs(x) <= _MAX_NUMBER for x in numbers]
    return len(usual) == wanted and all(usual)


@contextmanager
def install_guard(guard: AccessGuard, controls: Callable[[], Mapping[str, Any]]) -> Iterator[None]:
    """Servers that are started in the block ask the guard before they answer.

    Messages that are not valid are dropped. viser has no place for a guard: it hands its answers
    straight to `websockets`.

    Args:
        guard: The guard.
        controls: Returns the controls of the panel, by their identifiers.
    """
    import websockets.asyncio.server as server  # pyright: ignore[reportMissingImports]

    with _patch_lock:
        plain = server.serve

        def serve(handler: Any, *args: Any, **given: Any) -> Any:
            async def handle(connection: Any) -> None:
                receive = connection.recv

                async def receive_valid() -> Any:
                    while not is_valid_message(raw := await receive(), controls()):
                        pass
                    return raw

                connection.recv = receive_valid
                with suppress(Exception):  # whatever a client causes ends its own connection
                    await handler(connection)

            given |= {"process_request": guard.wrap_handler(given["process_request"])}
            return plain(handle, *args, **given | {"max_size": _MAX_MESSAGE})

        server.serve = serve
        try:
            yield
        finally:
            server.serve = plain


def _cookie_name(port: int) -> str:
    return f"invertwin_{port}"
