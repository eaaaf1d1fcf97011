"""Who may talk to the page's server: those who know its token, from the server's own page under one of its names, and
nobody else.

viser itself lets everybody in, also every web page that its user has open (browsers let any page open a WebSocket to
this machine). Its server asks a function of viser's about each request before anything is sent; the gate stands before
that function. The address that is printed holds the token once; the page that it opens gets it as a cookie, which other
sites' pages cannot send.
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

__all__ = ["Gate"]

_HOST = re.compile(r"[A-Za-z0-9.\-]+(:\d+)?|\[[0-9A-Fa-f:.]+\](:\d+)?")

_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' ws://{host} data: blob:; worker-src 'self' blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)
"""The page loads nothing from elsewhere and is in nobody's frame. viser's client is one inline script whose WebAssembly
makes its functions of texts, which takes 'unsafe-eval'."""


class Gate:
    """The check of one server.

    Attributes:
        token: 43 characters that nobody guesses.
        stands: whether it was put before a server.
    """

    def __init__(self, host: str = "localhost") -> None:
        """``host``: that the server listens on."""
        self.token = secrets.token_urlsafe(32)
        self.stands = False
        self._hosts = _hosts(host)

    def address(self, host: str, port: int) -> str:
        """What one opens in a browser."""
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={self.token}"

    @contextmanager
    def before_viser(self, refusal: Callable[[Any], str | None], refused: Callable[[Any, str], None]) -> Iterator[None]:
        """Servers of viser that start inside have the gate before them; check :attr:`stands` afterwards.

        Args:
            refusal, refused: of messages, see :class:`~neuprim.viewer.incoming.CheckedConnection`.

        viser hands its check of requests to ``websockets.asyncio.server.serve`` and has no place for another one; so it
        finds there, for the moment of its start, a ``serve`` that puts the gate in front.
        """
        from websockets.asyncio import server

        from neuprim.viewer.incoming import LARGEST, CheckedConnection

        plain = server.serve
        connection: Any = functools.partial(CheckedConnection, refusal=refusal, refused=refused)

        def guarded(*args: Any, process_request: Callable[..., Any] | None = None, **more: Any) -> Any:
            self.stands = True
            more |= {"max_size": LARGEST, "create_connection": connection}
            return plain(*args, process_request=self.guarding(process_request), **more)

        server.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = plain  # type: ignore[misc]

    def guarding(self, inner: Callable[..., Any] | None) -> Callable[[Any, Any], Any]:
        """A check of requests (connection, request) that asks ``inner`` only about those that may come in."""

        def check(connection: Any, request: Any) -> Any:
            reason = self.refusal(request.path, request.headers)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            response = None if inner is None else inner(connection, request)
            if response is not None:
                for name, value in self._more(request.headers).items():
                    response.headers[name] = value
            return response

        return check

    def refusal(self, path: str, headers: Any) -> str | None:
        """Why a request is refused; None for one that may come in.

        Args:
            path: with its query.
            headers: with ``get_all``, as websockets has them.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return "no host, or several"
        if not self._answers(
            hosts[0]
        ):  # a name of somebody else's that leads here, by which his page would pass for ours
            return f"this server's name is {' or '.join(self._hosts)}"
        if origins and (len(origins) != 1 or origins[0] != f"http://{hosts[0]}"):
            return "another site's page may not come in here"
        given = parse_qs(urlsplit(path).query).get("token", []) + self._cookies(headers, hosts[0])
        if not any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given):
            return "open the address that neuprim printed, with its token"
        return None

    def _answers(self, host: str) -> bool:
        """Whether a Host header has one of the server's names; where it listens on every address, also one of those, as
        nobody can bend it."""
        name = re.sub(r":\d+$", "", host).lower()
        return name in self._hosts or (_is_everywhere(self._hosts[-1]) and _is_address(name))

    def _more(self, headers: Any) -> dict[str, str]:
        """Headers of every answer."""
        host = headers["Host"]
        return {
            "Set-Cookie": f"{_name(host)}={self.token}; Path=/; HttpOnly; SameSite=Strict",
            "Content-Security-Policy": _POLICY.format(host=host),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }

    def _cookies(self, headers: Any, host: str) -> list[str]:
        parts = [part.strip().partition("=") for line in headers.get_all("Cookie") for part in line.split(";")]
        return [value for name, _, value in parts if name == _name(host)]


def _hosts(host: str) -> tuple[str, ...]:
    """Names of a server that listens on ``host``, as a Host header has them."""
    own = [socket.gethostname(), socket.getfqdn()] if _is_everywhere(host) else []
    asked = f"[{host}]" if ":" in host else host
    return tuple(dict.fromkeys(name.lower() for name in ("localhost", "127.0.0.1", "[::1]", *own, asked)))


def _is_everywhere(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host.strip("[]")).is_unspecified


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def _name(host: str) -> str:
    """Of the cookie; browsers do not tell ports apart, so that two viewers on one machine would share theirs."""
    return f"neuprim-{host.rpartition(':')[2] if re.search(r':[0-9]+$', host) else '80'}"
