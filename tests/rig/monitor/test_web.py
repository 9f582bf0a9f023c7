import contextlib
import http.client
import json
import re
import socket
import threading

import pytest

from softfin.core.errors import ConfigurationError
from softfin.rig.monitor import web
from softfin.rig.monitor.follow import Follower
from tests.patience import HANG_S
from tests.rig.monitor.bags import Recording


@contextlib.contextmanager
def serving(folder):
    bag = folder / "run.mcap"
    bag.write_bytes(
        Recording().chunk(250, reference=(1.0, 0.5), event="</script><b>armed</b>").bytes
    )
    served = web.Server(Follower(bag), 0)
    thread = threading.Thread(target=served.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    yield served
    served.shutdown()
    served.server_close()
    thread.join(HANG_S)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("bag")) as served:
        yield served


def ask(server, path="/", method="GET", host=None):
    connection = http.client.HTTPConnection(web.LOOPBACK, server.server_address[1], timeout=HANG_S)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def send(server, *pieces):
    """Raw bytes, and all that comes back."""
    with socket.create_connection(
        (web.LOOPBACK, server.server_address[1]), timeout=HANG_S
    ) as connection:
        for piece in pieces:
            connection.sendall(piece)
        received = b""
        try:
            while some := connection.recv(65536):
                received += some
        except ConnectionResetError:
            pass
        return received


def test_the_page_fetches_nothing_from_elsewhere_and_runs_only_its_own_script(server):
    answer, body = ask(server)
    page = body.decode()
    policy = answer.headers["Content-Security-Policy"]
    assert answer.status == 200
    assert not re.search(r"https?:|@import|url\(|import\s*\(|innerHTML|style=", page)
    assert "default-src 'none'" in policy
    assert "script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'" in policy
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    asked = set(re.findall(r'element\("(\w+)"\)', page))
    assert asked >= {"traces", "state", "events"}
    assert all(f'id="{name}"' in page for name in asked)


def test_the_data_are_what_was_recorded_and_come_once(server):
    answer, body = ask(server, "/data?since=0")
    data = json.loads(body)
    assert answer.headers["Content-Type"] == "application/json"
    assert data["rows"]["wrench"][-1] == [2.49, 1.0, -0.5, 0.25]
    assert len(data["rows"]["joint"]) == 250
    assert data["summary"]["events"] == [[0.0, "</script><b>armed</b>"]]
    again = json.loads(ask(server, f"/data?since={data['next']}")[1])
    assert all(not rows for rows in again["rows"].values())
    assert again["next"] == data["next"]


@pytest.mark.parametrize(
    "method", ["HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "CONNECT", "FOO"]
)
def test_whatever_would_change_something_is_refused(server, method):
    answer, _ = ask(server, "/", method)
    assert answer.status == 501


@pytest.mark.parametrize(
    "host",
    ["evil.example", "localhost.evil.example", "evil.example:80", "", "[::1", "192.168.1.7:8080"],
)
def test_a_name_that_is_not_ours_is_refused(server, host):
    answer, body = ask(server, "/data?since=0", host=host)
    assert answer.status == 403
    assert b"force" not in body


@pytest.mark.parametrize("host", ["localhost", "localhost:9000", "127.0.0.1:1"])
def test_this_computer_and_tunnels_to_it_are_known(server, host):
    assert ask(server, "/data?since=0", host=host)[0].status == 200


def test_a_request_without_host_is_refused(server):
    assert b" 403 " in send(server, b"GET / HTTP/1.1\r\n\r\n")


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd",
        "/../../etc/passwd",
        "/%2e%2e/x",
        "//evil.example/",
        "/page.html",
        "/data/",
        "/?a",
        "/data%00",
        "/data",
        "/data?since=-1",
        "/data?since=1&since=2",
        "/data?since=" + "9" * 99,
    ],
)
def test_there_is_nothing_else(server, path):
    assert ask(server, path)[0].status == 404


def test_slow_and_broken_requests_end(server, monkeypatch):
    monkeypatch.setattr(web._Handler, "timeout", 1.0)
    assert send(server, b"GET / HTTP/1.1\r\n") == b""
    assert send(server, b"\x00\xff\x16\x03\r\n\r\n")[:1] in (b"", b"H", b"<")


@contextlib.contextmanager
def idle(server, count):
    """Connections that never ask for anything."""
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(
                socket.create_connection((web.LOOPBACK, server.server_address[1]), timeout=HANG_S)
            )
            for _ in range(count)
        ]


def test_others_are_served_while_slow_clients_hold_connections(server):
    with idle(server, 64) as slow:
        slow[-1].sendall(b"GET / HTTP/1.1\r\nHost: local")
        assert [ask(server, "/data?since=0")[0].status for _ in range(20)] == 20 * [200]


def test_a_port_that_is_taken_is_said(server):
    with pytest.raises(ConfigurationError, match="use --port 0"):
        web.Server(server._follower, server.server_address[1])
    with pytest.raises(ConfigurationError, match="0-65535"):
        web.Server(server._follower, 70000)


def test_serving_ends_when_it_is_interrupted(tmp_path, monkeypatch):
    bag = tmp_path / "run.mcap"
    bag.write_bytes(Recording().chunk(5).bytes)
    served = web.Server(Follower(bag), 0)

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(served, "service_actions", interrupted)
    with served, pytest.raises(KeyboardInterrupt):
        served.serve_forever(0.05)
    with pytest.raises(ConnectionRefusedError):
        ask(served)
