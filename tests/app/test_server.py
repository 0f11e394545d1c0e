"""Who is let in, what leaves, and how the server begins and ends: a real one, over its port."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import psutil
import pytest

from app.serving import Served, answering, free_port, outside, served
from nerif.app.command import App
from nerif.app.pages import PAGES
from nerif.app.project.workspace import READ_ONLY
from nerif.app.server.guard import cookie_of
from nerif.app.server.private import page_leading_to
from nerif.app.server.server import Address, is_relevant
from nerif.cli.cli import main
from nerif.cli.settings import read_settings
from nerif.common.conventions import InputError
from refusals import refused
from report.browsing import needs_browser, wait_for

BOUND = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")  # root that rights of files hold for, too
STATIC = "/_nicegui/3.18.0/static/nicegui.css"
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"


def test_without_the_token_nothing_is_answered_and_with_the_cookie_it_is(server):
    for path in ("/", "/design", STATIC, SOCKET, "/design?token=wrong", "/nowhere"):
        status, headers, text = server.get(path)
        assert (status, "nicegui" in text, "set-cookie" in headers) == (403, False, False)
    for path in ("/design", STATIC, SOCKET):
        status, headers, _ = server.get(path, {"Cookie": server.cookie()})
        assert (status, "default-src 'self'" in headers["content-security-policy"]) == (200, True)


def test_the_token_is_exchanged_for_a_cookie_that_no_script_reads(server):
    status, headers, _ = server.get(f"/design?token={server.token}&x=1")
    assert (status, headers["refresh"]) == (200, "0; url=/design?x=1")
    stored = headers["set-cookie"]
    assert all(word in stored for word in ("HttpOnly", "SameSite=Strict", cookie_of(server.token)))
    assert server.token not in stored


def test_cookies_of_other_programs_lock_nobody_out(server):
    authorised = server.cookie()
    for foreign in ('prefs={"a":1}', "x[y]=1", "name=\xfc\xdf", "a", "=;;", f"nerif-{server.port}=old", authorised):
        for cookies in (f"{foreign}; {authorised}", f"{authorised};{foreign}"):
            assert server.get("/design", {"Cookie": cookies})[0] == 200
        assert server.get("/design", {"Cookie": foreign.replace(authorised, "")})[0] == 403


def test_a_foreign_name_that_leads_here_and_a_page_of_others_are_refused(server):
    cookie = {"Cookie": server.cookie()}
    for path in ("/design", STATIC, SOCKET, f"/?token={server.token}"):
        for host in ("evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1.evil.example:1"):
            assert server.get(path, {"Host": host, **cookie})[0] == 421
        for origin in ("http://evil.example", "null", "http://127.0.0.1:1", "file://"):
            assert server.get(path, {"Origin": origin, **cookie})[0] == 403


def upgrade(server: Served, *headers: str) -> str:
    """The first line of the answer to a browser that asks for a websocket."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as wire:
        lines = (
            "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1", f"Host: 127.0.0.1:{server.port}",
            "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", *headers, "", "",
        )  # fmt: skip
        wire.sendall("\r\n".join(lines).encode())
        return wire.recv(4096).decode("latin-1").splitlines()[0]


def test_the_websocket_too(server):
    cookie = f"Cookie: {server.cookie()}"
    assert " 403" in upgrade(server)
    assert " 403" in upgrade(server, cookie, "Origin: http://evil.example")
    assert " 101" in upgrade(server, cookie, f"Origin: http://127.0.0.1:{server.port}")


HUB, ROOT = "hub.example.org", "/user/me%40b/proxy/8620"


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server behind JupyterHub's proxy, and at the end of a tunnel."""
    options = ["--allowed-host", "localhost:9000", "--allowed-host", HUB, "--root-path", f"{ROOT}/"]
    with served(tmp_path_factory.mktemp("project"), *options) as server:
        yield server


@pytest.mark.parametrize("inside", ["", ROOT, ROOT.replace("%40", "@")])
@pytest.mark.parametrize("host", [HUB, "localhost:9000", ""])
def test_a_tunnel_and_a_proxy_that_removes_or_keeps_its_path(proxied, host, inside):
    """jupyter-server-proxy passes the browser's Host and Origin on, and states its path besides."""
    authorised = {"Host": host or f"127.0.0.1:{proxied.port}", "X-Forwarded-Prefix": ROOT}
    status, headers, _ = proxied.get(f"{inside}/?token={proxied.token}", authorised)
    assert (status, headers["refresh"]) == (200, f"0; url={ROOT}/")
    assert f"Path={ROOT};" in headers["set-cookie"] + ";"
    authorised |= {"Cookie": headers["set-cookie"].partition(";")[0], "Origin": f"https://{authorised['Host']}"}
    assert proxied.get(f"{inside}/", authorised)[1]["location"] == "design"
    page = proxied.get(f"{inside}/design", authorised)[2]
    assert f'src="{ROOT}{STATIC.rpartition("/")[0]}/nicegui.js"' in page
    assert ROOT + ROOT not in page
    assert proxied.get(inside + STATIC, authorised)[0] == proxied.get(inside + SOCKET, authorised)[0] == 200
    assert "href='results'" in page.replace("\\u003E", ">").replace("\\", "")
    assert " 101" in upgrade(proxied, f"Cookie: {authorised['Cookie']}", f"Origin: {authorised['Origin']}")


def test_an_allowed_host_admits_no_other(proxied):
    cookie = proxied.get("/?token=" + proxied.token)[1]["set-cookie"].partition(";")[0]
    for host in ("hub.example.org:8443", "hub.example.org.evil.example", "localhost:9001", "localhost", "evil.example"):
        assert proxied.get("/design", {"Host": host, "Cookie": cookie})[0] == 421
        for scheme in ("http", "https"):
            assert proxied.get("/design", {"Host": HUB, "Origin": f"{scheme}://{host}", "Cookie": cookie})[0] == 403
    assert proxied.get("/design", {"Host": HUB})[0] == 403
    status, _, page = proxied.get("/design", {"Host": HUB, "Cookie": cookie, "X-Forwarded-Prefix": "//evil"})
    assert (status, "evil" in page) == (200, False)


def test_a_refused_address_names_the_option_and_the_token(server):
    text = server.get("/design", {"Host": "localhost:9000", "Cookie": server.cookie()})[2]
    assert "address of this server: localhost:9000. If that is a tunnel or proxy" in text
    assert "--allowed-host localhost:9000 (and --root-path" in text
    authorised = {"Host": f"127.0.0.1:{server.port}", "Cookie": server.cookie()}
    assert (
        "--allowed-host hub.example.org "
        in server.get("/design", {**authorised, "Origin": "https://hub.example.org"})[2]
    )
    assert "/?token=..." in server.get("/design")[2]
    for strange in ("<b>x</b>", "a b", "x;rm", "h:port"):
        assert server.get("/design", {"Host": strange})[::2] == (421, "This is not an address of this server.")


@pytest.mark.parametrize(("option", "values"), [
    ("allowed-host", ("https://hub.example.org", "*", "hub.example.org/user")),
    ("root-path", ("user/me", "//evil.example", "/a?b", "/<b>")), ("token", ("short",)), ("port", ("0",)),
])  # fmt: skip
def test_addresses_that_are_none_are_refused(tmp_path, option, values):
    for value in values:
        with pytest.raises(InputError, match=f"{option.replace('-', '.')}: expected"):
            read_settings(App(), [str(tmp_path), f"--{option}", value], "app")


def test_it_listens_on_this_machine_alone(server):
    with socket.socket() as probe:
        authorised = socket.gethostbyname(socket.gethostname())
        if authorised.startswith("127."):
            pytest.skip("this machine has no other address than its own")
        assert probe.connect_ex((authorised, server.port)) != 0


def test_others_are_let_in_with_a_token_only():
    with refused("host"):
        Address.of("0.0.0.0", 8000, None)
    assert "[::1]" in Address("::1", 1, "x" * 16).names


def test_a_server_for_all_interfaces_answers_to_the_address_of_each(monkeypatch):
    """Debian writes the machine's name beside 127.0.1.1 into /etc/hosts."""
    there = {
        "eth0": [(socket.AF_INET, "192.0.2.7"), (socket.AF_INET6, "fe80::1%eth0"), (-1, "02:00:5e:10:00:00")],
        "lo": [(socket.AF_INET, "127.0.0.1")],
    }  # fmt: skip
    child = {name: [SimpleNamespace(family=f, address=a) for f, a in rows] for name, rows in there.items()}
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: child)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: [(socket.AF_INET, 1, 6, "", ("127.0.1.1", 0))])
    names = Address("0.0.0.0", 1, "x" * 16).names
    assert {"192.0.2.7", "[fe80::1]", socket.gethostname()} <= set(names)
    assert not any("02:00" in name or "%" in name for name in names)
    assert "192.0.2.7" not in Address("127.0.0.1", 1, "x" * 16).names


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "0.0.0.0", "192.0.2.7"])
def test_the_address_to_open_is_one_that_is_answered(host):
    address = Address(host, 8620, "x" * 16)
    assert urlsplit(address.link).netloc.removesuffix(":8620") in address.names


def test_a_port_that_is_taken_gives_the_next(capsys):
    with socket.socket() as first:
        first.bind(("127.0.0.1", 0))
        first.listen()
        port = first.getsockname()[1]
        assert Address.of("127.0.0.1", port, None).port > port
    assert f"port {port} is in use" in capsys.readouterr().out


def test_without_a_folder_or_nicegui_the_remedy_is_said(tmp_path, capsys, monkeypatch):
    assert main(["app", str(tmp_path / "nowhere"), "--no-browser"]) == 2
    assert "expected a folder to work in" in capsys.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["app", str(tmp_path)]) == 2
    assert "pip install 'nerif-bost[app]'" in capsys.readouterr().err


def test_a_browser_is_led_in_without_the_token_on_its_command_line_and_ctrl_c_ends_all(tmp_path: Path):
    browser, started = tmp_path / "browser", tmp_path / "started"
    browser.write_text(f'#!/bin/sh\necho "$@" > {started}.part && mv {started}.part {started}\n')
    browser.chmod(0o755)
    words = [sys.executable, "-m", "nerif", "app", str(tmp_path), "--port", str(free_port())]
    environment = {**outside(), "BROWSER": f"{browser} %s", "XDG_STATE_HOME": str(tmp_path / "state")}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        served = answering(tmp_path, process.stdout)
        until = time.monotonic() + 20
        while not started.is_file():
            assert time.monotonic() < until
            time.sleep(0.02)
        address = started.read_text().strip()
        assert served.token not in address
        page = Path(address.removeprefix("file://"))
        assert served.link in page.read_text()
        assert page.stat().st_mode & 0o077 == 0
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=20)
        assert process.returncode == 0
        assert "Traceback" not in rest
        assert not page.exists()


def test_a_page_that_cannot_be_kept_from_others_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(InputError, match=r"expected a directory .* set XDG_STATE_HOME"), page_leading_to("http://x:1/"):
        pass


def test_a_token_may_stand_in_a_file_instead_of_the_command_line(tmp_path):
    (tmp_path / "app.toml").write_text('token = "0123456789abcdef"\n')
    settings = read_settings(App(), [str(tmp_path), "--config", str(tmp_path / "app.toml")], "app")
    assert (settings.folder, settings.token) == (tmp_path, "0123456789abcdef")


@needs_browser
def test_a_browser_is_let_in_by_way_of_the_page(browser, server):
    """It comes from another site: a cookie with SameSite=Strict is not sent to where a redirect leads then."""
    with page_leading_to(server.link) as page:
        browser.get(page)
        wait_for(browser, "return location.pathname === '/design' && window.socket?.connected")
    assert server.token not in browser.current_url


@needs_browser
def test_pages_below_the_path_of_a_proxy_lead_to_one_another(browser, proxied):
    browser.get(f"http://127.0.0.1:{proxied.port}{ROOT}/?token={proxied.token}")
    wait_for(browser, f"return location.pathname === '{ROOT}/design' && window.socket?.connected")
    browser.execute_script("document.querySelector(\"nav a[href='results']\").click()")
    wait_for(browser, f"return location.pathname === '{ROOT}/results' && window.socket?.connected")


@pytest.mark.slow
def test_a_folder_without_rights_is_refused_in_one_line_and_can_be_read(tmp_path):
    root = os.geteuid() == 0
    if root and shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and setpriv, by which it may not, is not there")
    tmp_path.chmod(0o555)
    with served(tmp_path, by=BOUND if root else ()) as server:
        assert f"note: {READ_ONLY}" in server.output
        for page in PAGES:
            assert READ_ONLY in server.get(page.path, {"Cookie": server.cookie()})[2]
    tmp_path.chmod(0o755)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("error", "logged"), [("No response returned.", False), ("out of tune", True)])
def test_a_browser_that_goes_on_is_no_error_and_all_else_is(error, logged):
    try:
        raise RuntimeError(error)
    except RuntimeError:
        entry = logging.LogRecord("uvicorn.error", logging.ERROR, "", 0, "Exception", (), sys.exc_info())
    assert is_relevant(entry) is logged
    assert is_relevant(logging.LogRecord("uvicorn.error", logging.INFO, "", 0, "ready", (), None))
