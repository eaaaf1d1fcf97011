"""Access check of the viewer's server: a secret token, the server's own host names, and its own page as origin.

viser accepts every client, including any web page open in the user's browser, because browsers let pages open
WebSockets to this machine. The printed address holds the token; the page receives it as a cookie, which other sites'
pages cannot send.
"""

from __future__ import annotations

import functools
import hmac
import http
import ipaddress
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

from neuprim.viewer.messages import MAX_MESSAGE_BYTES, CheckedConnection

__all__ = ["TokenAuth"]

_HOST = re.compile(r"[A-Za-z0-9.\-]+(:\d+)?|\[[0-9A-Fa-f:.]+\](:\d+)?")

# viser's client is one inline script, and its WebAssembly needs 'unsafe-eval'.
_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' ws://{host} data: blob:; worker-src 'self' blob:; "
    "frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)


class TokenAuth:
    """Check requests to one server that listens on ``host``.

    Attributes:
        token: random, 43 characters.
        installed: whether a server has started behind the check.
    """

    def __init__(self, host: str = "localhost") -> None:
        self.token = secrets.token_urlsafe(32)
        self.installed = False
        own = [socket.gethostname(), socket.getfqdn()] if _is_unspecified(host) else []
        listens = f"[{host}]" if ":" in host else host
        self._hosts = tuple(dict.fromkeys(x.lower() for x in ("localhost", "127.0.0.1", "[::1]", *own, listens)))

    def page_address(self, host: str, port: int) -> str:
        """Return the address to open in a browser."""
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={self.token}"

    @contextmanager
    def guard_server(
        self, check_message: Callable[[Any], str | None], on_refusal: Callable[[Any, str], None]
    ) -> Iterator[None]:
        """Put the checks before every viser server started inside; see :attr:`installed` afterwards.

        viser passes its own request hook to ``websockets.asyncio.server.serve`` and offers no way to add one. So
        ``serve`` is replaced while viser starts. A proxy in front would leave viser's own port open to every page.

        Args:
            check_message, on_refusal: see :class:`~neuprim.viewer.messages.CheckedConnection`.
        """
        from websockets.asyncio import server

        original = server.serve
        connection: Any = functools.partial(CheckedConnection, check_message=check_message, on_refusal=on_refusal)

        def serve(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
            self.installed = True
            options |= {"max_size": MAX_MESSAGE_BYTES, "create_connection": connection}
            return original(*args, process_request=self.guard_requests(process_request), **options)

        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = original  # type: ignore[misc]

    def guard_requests(self, inner: Callable[..., Any] | None) -> Callable[[Any, Any], Any]:
        """Wrap a websockets request hook (connection, request) in the check."""

        def check(connection: Any, request: Any) -> Any:
            reason = self.refuse_request(request.path, request.headers)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            response = None if inner is None else inner(connection, request)
            if response is not None:
                host = request.headers["Host"]
                response.headers["Set-Cookie"] = f"{_cookie_name(host)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                response.headers["Content-Security-Policy"] = _POLICY.format(host=host)
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["X-Content-Type-Options"] = "nosniff"
                response.headers["Cache-Control"] = "no-store"
            return response

        return check

    def refuse_request(self, path: str, headers: Any) -> str | None:
        """Return why a request is refused, None if it is allowed.

        Args:
            path: with its query.
            headers: a websockets ``Headers``.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return "no host, or several"
        if not self._is_own_name(hosts[0]):  # DNS rebinding: a foreign name that resolves to this machine
            return f"this server's name is {' or '.join(self._hosts)}"
        if origins and (len(origins) != 1 or origins[0] != f"http://{hosts[0]}"):
            return "another site's page may not come in here"
        cookies = [part.strip().partition("=") for line in headers.get_all("Cookie") for part in line.split(";")]
        given = parse_qs(urlsplit(path).query).get("token", [])
        given += [value for name, _, value in cookies if name == _cookie_name(hosts[0])]
        if not any(hmac.compare_digest(token.encode(), self.token.encode()) for token in given):
            return "open the address that neuprim printed, with its token"
        return None

    def _is_own_name(self, host: str) -> bool:
        """A server that listens on every address also answers to any IP address, which nobody can rebind."""
        name = re.sub(r":\d+$", "", host).lower()
        return name in self._hosts or (_is_unspecified(self._hosts[-1]) and _parse_ip(name) is not None)


def _parse_ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def _is_unspecified(host: str) -> bool:
    address = _parse_ip(host)
    return address is not None and address.is_unspecified


def _cookie_name(host: str) -> str:
    """Browsers send cookies to all ports of a host, so each port has its own name."""
    return f"neuprim-{host.rpartition(':')[2] if re.search(r':[0-9]+$', host) else '80'}"
