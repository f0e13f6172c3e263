"""Who may look at a viewer."""

import http.client
import importlib.util
import socket
from contextlib import closing
from email.message import Message

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import Object, RoughDielectric, Scene, box, rigid
from invertwin.viewer import AccessGuard, Viewer, build_display

TOKEN = "a-token_of-16-and-more"
NEEDS_VISER = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs: pip install "invertwin[view]"'
)


class Headers(Message):
    """As those of `websockets`: an empty list where there is none."""

    def get_all(self, name: str) -> list[str]:  # type: ignore[override]
        return super().get_all(name, [])


def headers(**given: str) -> Headers:
    made = Headers()
    for name, value in given.items():
        made[name] = value
    return made


def answered(viewer: Viewer, path: str = "/", **given: str) -> http.client.HTTPResponse:
    port = viewer._server.get_port()
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
        connection.request("GET", path, headers=given)
        response = connection.getresponse()
        response.close()
        return response


def cube() -> Scene:
    pose = rigid(translation=torch.tensor([2.0, 0.0, 0.0]).double())
    return Scene({"cube": Object(box((0.2, 0.2, 0.2)), RoughDielectric(4.0), pose)})


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_host_that_others_reach_needs_a_token(host):
    with pytest.raises(InputError, match="expected a token for the host"):
        AccessGuard(host)
    AccessGuard(host, TOKEN)


@pytest.mark.parametrize("token", ["short", "with a space in it, and long"])
def test_a_token_that_can_be_guessed_or_breaks_the_address_is_refused(token):
    with pytest.raises(InputError, match="at least 16 letters, digits"):
        AccessGuard("127.0.0.1", token)


def test_a_host_of_another_machine_is_refused():
    with pytest.raises(InputError, match="address of this machine"):
        AccessGuard("192.0.2.1", TOKEN)


def test_loopback_admits_its_own_names_and_pages_alone():
    guard = AccessGuard("127.0.0.1")
    assert guard.admits("/", headers(Host="127.0.0.1:8080"), 8080)
    assert guard.admits("/", headers(Host="localhost:8080", Origin="http://localhost:8080"), 8080)
    assert not guard.admits("/", headers(Host="rebound.example:8080"), 8080)
    other = headers(Host="127.0.0.1:8080", Origin="http://other.example")
    assert not guard.admits("/", other, 8080)


@pytest.mark.parametrize(
    "host",
    [
        *("127.0.0.1", "127.0.0.1:8081", "127.0.0.1:08080", "localhost.:8080", "0.0.0.0:8080"),
        *("LOCALHOST.evil:8080", "127.0.0.2:8080", "[::1]:8081", "2130706433:8080"),
    ],
)
def test_loopback_has_an_exact_set_of_hosts(host):
    assert not AccessGuard("127.0.0.1").admits("/", headers(Host=host), 8080)


@pytest.mark.parametrize(
    ("origin", "admitted"),
    [
        ("http://127.0.0.1:8080", True),
        ("http://127.0.0.1:8080/", False),
        ("http://127.0.0.1:80800", False),
        ("http://127.0.0.1:8080@evil", False),
        ("http://evil@127.0.0.1:8080", False),
        ("ftp://127.0.0.1:8080", False),
        ("http://[", False),
        ("null", False),
        ("", False),
    ],
)
def test_origins_are_those_of_the_host(origin, admitted):
    given = headers(Host="127.0.0.1:8080", Origin=origin)
    assert AccessGuard("127.0.0.1").admits("/", given, 8080) == admitted


MALFORMED = ("evil\\@127.0.0.1:8080", "127.0.0.1:8080:evil", "[", "a b", "é:8080", "", "a@b:80")


@pytest.mark.parametrize("host", MALFORMED)
@pytest.mark.parametrize("token", [None, TOKEN])
def test_a_malformed_host_is_malformed_with_a_token_too(host, token):
    with pytest.raises(ValueError, match="one host"):
        AccessGuard("127.0.0.1", token).admits(f"/?token={TOKEN}", headers(Host=host), 8080)


@pytest.mark.parametrize("path", ["/\0", "/%00", "/%0a", "/" + "a" * 5000, "/?token=%ff%fe%00"])
def test_a_malformed_path_is_malformed(path):
    with pytest.raises(ValueError, match="plain path"):
        AccessGuard("127.0.0.1").admits(path, headers(Host="127.0.0.1:8080"), 8080)


@NEEDS_VISER
def test_malformed_requests_are_400_and_no_path_raises(capfd):
    with Viewer(build_display(cube(), {}, "cube"), port=0) as viewer:
        for host in MALFORMED:
            if host.isascii():
                assert answered(viewer, Host=host).status == 400
        statuses = {
            answered(viewer, path).status
            for path in (
                *("/%00", "/%0d%0a", "/" + "a" * 300, "/" + "a/" * 400, "/%ff", "//[", "/?[", "/%"),
                *("/.", "/..", "/%2e", "/\\..\\..", "//evil.example/", "/index.html/x"),
                *("/http://[evil", "/;a=b", "/~", "/%F0%9F%98%80"),
            )
        }
        assert statuses <= {200, 400, 403, 404}
        assert answered(viewer, Cookie="a=b; (=[;;; =; expires").status == 200
        assert answered(viewer).status == 200
    assert "Traceback" not in capfd.readouterr().err


def test_the_token_is_asked_for_in_address_or_cookie():
    guard = AccessGuard("0.0.0.0", TOKEN)
    host = {"Host": "192.0.2.1:8080"}
    assert guard.admits(f"/?token={TOKEN}", headers(**host), 8080)
    assert guard.admits("/", headers(**host, Cookie=f"invertwin_8080={TOKEN}"), 8080)
    assert not guard.admits("/", headers(**host), 8080)
    assert not guard.admits(f"/?token={TOKEN}x", headers(**host), 8080)
    # A cookie of another viewer on this machine.
    assert not guard.admits("/", headers(**host, Cookie=f"invertwin_8081={TOKEN}"), 8080)


@NEEDS_VISER
def test_a_wrong_token_gets_403_and_the_right_one_a_cookie():
    with Viewer(build_display(cube(), {}, "cube"), port=0, token=TOKEN) as viewer:
        assert viewer.address.endswith(f"/?token={TOKEN}")
        assert answered(viewer).status == 403
        assert answered(viewer, "/?token=another-token-of-16").status == 403
        found = answered(viewer, f"/?token={TOKEN}")
        assert found.status == 200
        cookie = str(found.headers["Set-Cookie"])
        assert "HttpOnly; SameSite=Strict" in cookie
        assert answered(viewer, Cookie=cookie.split(";")[0]).status == 200
        upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        upgrade |= {"Sec-WebSocket-Key": "MDEyMzQ1Njc4OWFiY2RlZg=="}
        assert answered(viewer, **upgrade).status == 403
        assert answered(viewer, Cookie=cookie.split(";")[0], **upgrade).status == 101


@NEEDS_VISER
def test_the_address_for_others_names_this_machine():
    with Viewer(build_display(cube(), {}, "cube"), host="0.0.0.0", port=0, token=TOKEN) as viewer:
        assert viewer.address.startswith(f"http://{socket.gethostname()}:")


@NEEDS_VISER
def test_two_viewers_at_once():
    first, second = (build_display(cube(), {}, name) for name in ("one", "two"))
    with Viewer(first, port=0) as one, Viewer(second, port=0) as two:
        assert one.address != two.address
        assert [answered(one).status, answered(two).status] == [200, 200]
    with pytest.raises(ConnectionError):
        answered(one)


@NEEDS_VISER
def test_files_beside_the_page_are_not_served():
    with Viewer(build_display(cube(), {}, "cube"), port=0) as viewer:
        assert answered(viewer, "/../../__init__.py").status == 404
        assert answered(viewer, "/%2e%2e/%2e%2e/__init__.py").status == 404
