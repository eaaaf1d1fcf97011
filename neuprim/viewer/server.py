"""The viewer's web server: viser with checks of every request and every message.

viser accepts every client, including any web page open in the user's browser, because browsers let pages open
WebSockets to this machine. Therefore a request must have a secret token, the server's own host name, and the viewer's
page as origin. The printed address contains the token. The page gets the token as a cookie, which pages of other sites
cannot send.

viser does not check messages either. :class:`ViewerConnection` passes a message only if the code of the viewer's page
sends messages of this type. A message that sets a control passes only if the control can take the value.

Importing this module raises BackendUnavailable if viser is missing.
"""

from __future__ import annotations

import contextlib
import functools
import hmac
import http
import io
import ipaddress
import math
import operator
import re
import secrets
import socket
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs, urlsplit

from neuprim.config.command_settings import ViewerSettings
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.validation import Range

try:
    import msgspec
    import viser
    from msgspec import Meta
    from websockets.asyncio import server as websocket_server
except ImportError as error:
    raise BackendUnavailable(
        f"a viewer in the browser needs the package viser ({error}): pip install 'neuprim[viewer]'"
    ) from error

_HOST = re.compile(r"[A-Za-z0-9.\-]+(:\d+)?|\[[0-9A-Fa-f:.]+\](:\d+)?")

# viser's client is one inline script, and its WebAssembly needs 'unsafe-eval'.
_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' ws://{host} data: blob:; worker-src 'self' blob:; "
    "frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)


class TokenAuth:
    """Check of every request to a viser server: secret token, host name and origin.

    Attributes:
        token: random text of 43 characters.
        installed: whether a server with this check has started.
    """

    def __init__(self, host: str) -> None:
        self.token = secrets.token_urlsafe(32)
        self.installed = False
        own = [socket.gethostname(), socket.getfqdn()] if _is_unspecified_viewer_host(host) else []
        listens = f"[{host}]" if ":" in host else host
        self._hosts = tuple(dict.fromkeys(x.lower() for x in ("localhost", "127.0.0.1", "[::1]", *own, listens)))

    def page_address(self, host: str, port: int) -> str:
        """Return the address to open in a browser, with the token."""
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={self.token}"

    @contextlib.contextmanager
    def guard_server(
        self, check_message: Callable[[Any], str | None], on_refusal: Callable[[Any, str], None]
    ) -> Iterator[None]:
        """Return a context manager that adds the checks to a viser server.

        The server must start inside the context; :attr:`installed` is then True.

        viser passes its own request hook to ``websockets.asyncio.server.serve`` and offers no way to add another hook.
        Therefore ``serve`` is replaced while viser starts. A proxy in front of viser would be no protection, because
        every page could still reach viser's own port. The arguments are those of :class:`ViewerConnection`.
        """
        original = websocket_server.serve
        connection: Any = functools.partial(ViewerConnection, check_message=check_message, on_refusal=on_refusal)

        def serve(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
            self.installed = True
            options |= {"max_size": MAX_MESSAGE_BYTES, "create_connection": connection}
            return original(*args, process_request=self.guard_requests(process_request), **options)

        websocket_server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websocket_server.serve = original  # type: ignore[misc]

    def guard_requests(self, inner: Callable[..., Any] | None) -> Callable[[Any, Any], Any]:
        """Return a websockets request hook (connection, request) that checks the request and then calls ``inner``."""

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
        """Return why a request is refused; None if it is allowed. ``headers``: ``Headers`` of websockets."""
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
        """Return whether ``host``, from a request's Host header, is a name of this server.

        If the server listens on all addresses, any IP address is accepted as its name. This is safe, because DNS
        rebinding attacks need a host name.
        """
        name = re.sub(r":\d+$", "", host).lower()
        return name in self._hosts or (_is_unspecified_viewer_host(self._hosts[-1]) and _parse_ip(name) is not None)


def _parse_ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def _is_unspecified_viewer_host(host: str) -> bool:
    address = _parse_ip(host)
    return address is not None and address.is_unspecified


def _cookie_name(host: str) -> str:
    """Return the name of the cookie that holds the token.

    The name contains the port, because browsers send cookies to all ports of a host.
    """
    return f"neuprim-{host.rpartition(':')[2] if re.search(r':[0-9]+$', host) else '80'}"


# ------------------------------------------------------------ messages

MAX_MESSAGE_BYTES = 2**16  # messages of a page have some hundred bytes

_MAX_TEXT = 4096

_Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]  # NaN is refused, too
_Vector = tuple[_Finite, _Finite, _Finite]
_Pixels = Annotated[int, Meta(ge=0, le=2**14)]
_Name = Annotated[str, Meta(max_length=1024)]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Base class of the messages that the viewer accepts from a page. Other messages are refused, e.g. file uploads."""


class ViewerCameraMessage(_Message):
    wxyz: tuple[_Finite, _Finite, _Finite, _Finite]
    position: _Vector
    fov: Annotated[float, Meta(ge=1e-3, le=3.14)]
    near: _Finite
    far: _Finite
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector


class ScenePointerMessage(_Message):
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: Annotated[list[tuple[_Finite, _Finite]], Meta(max_length=1)]
    modifier: _Name | None = None


class TransformControlsUpdateMessage(_Message):
    name: _Name
    wxyz: tuple[_Finite, _Finite, _Finite, _Finite]
    position: _Vector
    owner: _Name = ""


class TransformControlsDragStartMessage(_Message):
    name: _Name
    owner: _Name = ""


class TransformControlsDragEndMessage(_Message):
    name: _Name
    owner: _Name = ""


class _Updates(msgspec.Struct, forbid_unknown_fields=True):
    value: Any


class GuiUpdateMessage(_Message):
    uuid: _Name
    updates: _Updates


_KINDS: Any = functools.reduce(operator.or_, _Message.__subclasses__())
_DECODER = msgspec.msgpack.Decoder(_KINDS)


class ViewerConnection(websocket_server.ServerConnection):
    """WebSocket connection that drops invalid messages.

    A message is invalid if ``check_message`` returns a reason. The connection then calls ``on_refusal(self, reason)``.
    """

    def __init__(
        self,
        *args: Any,
        check_message: Callable[[Any], str | None],
        on_refusal: Callable[[Any, str], None],
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._check, self._on_refusal = check_message, on_refusal

    async def recv(self, decode: bool | None = None) -> Any:
        while (reason := self._check(message := await super().recv(decode))) is not None:
            self._on_refusal(self, reason)
        return message


def refuse_message(message: bytes | str, find_control: Callable[[str], Any]) -> str | None:
    """Return why a message from a page must be dropped; None if it is accepted.

    ``find_control`` maps the id of a control to viser's handle, or to None if there is no such control.
    """
    if not isinstance(message, bytes):
        return "a message in text; expected msgpack"
    try:
        decoded = _DECODER.decode(message)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        return f"a message that this page does not send: {' '.join(str(error).split())[:200]}"
    quaternion = getattr(decoded, "wxyz", (1.0,))
    if not 0.99 < math.hypot(*quaternion) < 1.01:
        return "a message that this page does not send: expected a unit quaternion - at `$.wxyz`"
    if not isinstance(decoded, GuiUpdateMessage):
        return None
    handle = find_control(decoded.uuid)
    if handle is None:
        return "a control that is not there"
    reason = refuse_control_value(handle, decoded.updates.value)
    return None if reason is None else f"{getattr(handle, 'label', 'a control')}: {reason}"


def refuse_control_value(handle: Any, value: Any) -> str | None:
    """Return why a control cannot take a value; None if it can. The control's type, choices and bounds decide."""
    now, props = handle._impl.value, handle._impl.props
    options, low, high, step = (getattr(props, name, None) for name in ("options", "min", "max", "step"))
    if getattr(props, "disabled", False):
        return "cannot be set"
    if options is not None:
        return None if isinstance(value, str) and value in options else f"is not one of the {len(options)} choices"
    if isinstance(now, bool):
        return None if isinstance(value, bool) else "expected true or false"
    if isinstance(now, str):
        fits = isinstance(value, str) and len(value) <= _MAX_TEXT
        return None if fits else f"expected a text of at most {_MAX_TEXT} characters"
    if not isinstance(now, int | float):
        return "takes no value"
    whole = isinstance(now, int)
    slack = 0.0 if whole or step is None else step / 2  # a page rounds to the digits of its steps
    bounds = Range(None if low is None else low - slack, None if high is None else high + slack)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e15 and bounds.accepts(value):
        if not whole or float(value).is_integer():
            return None
    return f"expected {Range(low, high).words('a whole number' if whole else 'a number')}"


# ------------------------------------------------------------ server


def is_loopback(host: str) -> bool:
    """Return whether a server that listens on this host can only be reached from this machine."""
    address = _parse_ip(host)
    return host == "localhost" or (address is not None and address.is_loopback)


class ViewerServer:
    """A running viser server whose requests and messages are checked.

    Attributes:
        viser: the ``ViserServer``.
        address: address of the page, with the token.

    Raises:
        ConfigError: the host or port is not available.
        BackendUnavailable: the installed version of viser does not support the checks.
    """

    def __init__(self, settings: ViewerSettings, title: str) -> None:
        self._on_refusal: Callable[[int, str], None] = lambda client, reason: None
        auth = TokenAuth(settings.host)
        # Pages may be closed while something is sent to them.
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        port = _free_viewer_port(settings.host, settings.port)
        guarded = auth.guard_server(lambda message: refuse_message(message, self._find_control), self._report_refusal)
        with contextlib.redirect_stdout(io.StringIO()), guarded:
            self.viser: Any = viser.ViserServer(host=settings.host, port=port, label=title, verbose=False)
        if not (auth.installed and self.viser.get_port() == port):
            self.close()
            raise BackendUnavailable(
                f"viser {viser.__version__} did not start with access control on port {port}; "
                "install a supported version: pip install -c constraints.txt 'neuprim[viewer]'"
            )
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="large")
        # Even light, so that ellipsoids keep nearly their own colours.
        self.viser.scene.configure_environment_map(hdri=None)
        self.viser.scene.configure_default_lights(cast_shadow=False)
        self.viser.scene.add_light_ambient("/light", intensity=1.0)
        self.viser.gui.main_panel.dock_right()
        self.address = auth.page_address(settings.host, port)

    def on_client(
        self, connect: Callable[[Any], None], disconnect: Callable[[Any], None], refuse: Callable[[int, str], None]
    ) -> None:
        """Set callbacks for opened and closed pages (called with ``viser.ClientHandle``) and for refused messages
        (called with the page's id and the reason).
        """
        self._on_refusal = refuse
        self.viser.on_client_connect(connect)
        self.viser.on_client_disconnect(disconnect)

    def _find_control(self, uuid: str) -> Any:
        handles = (client.gui._gui_input_handle_from_uuid for client in self.viser.get_clients().values())
        return next((known[uuid] for known in handles if uuid in known), None)

    def _report_refusal(self, connection: Any, reason: str) -> None:
        for number, own in self.viser._websock_server._live_connections.items():
            if own is connection:
                self._on_refusal(number, reason)

    def close(self) -> None:
        """Disconnect all pages and free the port."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()


def _free_viewer_port(host: str, port: int) -> int:
    """Return ``port``, or any free port if ``port`` is 0; ConfigError if ``port`` is in use."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, number, _, address = found[0]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except OSError as error:
        raise ConfigError(
            f"viewer at {host}, port {port}: {error.strerror or error}; "
            "expected an address of this machine and a free port"
        ) from error
