"""The viewer's web server: viser behind the access and message checks."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import socket
import warnings
from collections.abc import Callable
from typing import Any

from neuprim.config.command_settings import ViewerSettings
from neuprim.core.errors import BackendUnavailable, ConfigError


def require_viser() -> Any:
    """Import viser; raise BackendUnavailable if it is missing."""
    try:
        import viser
    except ImportError as error:
        raise BackendUnavailable(
            f"a viewer in the browser needs the package viser ({error}): pip install 'neuprim[viewer]'"
        ) from error
    return viser


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server on this host."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class ViewerServer:
    """A running viser server.

    Attributes:
        viser: the ``ViserServer``.
        address: of the page, with the token.

    Raises:
        ConfigError: host or port are unavailable.
        BackendUnavailable: viser is missing, or a version that cannot be checked.
    """

    def __init__(self, settings: ViewerSettings, title: str) -> None:
        viser = require_viser()
        from neuprim.viewer.auth import TokenAuth, refuse_message

        self._on_refusal: Callable[[int, str], None] = lambda client, reason: None
        auth = TokenAuth(settings.host)
        # Pages may be closed while something is sent to them.
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        port = _free_viewer_port(settings.host, settings.port)
        guarded = auth.guard_server(lambda message: refuse_message(message, self._find_control), self._report_refusal)
        with contextlib.redirect_stdout(io.StringIO()), guarded:
            self.viser = viser.ViserServer(host=settings.host, port=port, label=title, verbose=False)
        if not (auth.installed and self.viser.get_port() == port and self._restrict_messages()):
            self.close()
            raise BackendUnavailable(
                f"viser {viser.__version__} did not start behind the check of its visitors, or not on port {port}; "
                "pip install -c constraints.txt 'neuprim[viewer]' has a version that does"
            )
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="large")
        # Even light, so that ellipsoids keep nearly their own colours.
        self.viser.scene.configure_environment_map(hdri=None)
        self.viser.scene.configure_default_lights(cast_shadow=False)
        self.viser.scene.add_light_ambient("/light", intensity=1.0)
        self.viser.gui.main_panel.dock_right()
        self.address = auth.page_address(settings.host, port)

    def _restrict_messages(self) -> bool:
        """Turn off viser's tunnels, which a page could ask for; return whether this version's messages are known."""
        try:
            from viser import _messages

            from neuprim.viewer.auth import is_known_viewer_protocol

            for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
                self.viser._websock_server.unregister_handler(kind)
        except (ImportError, AttributeError, AssertionError):  # another version of viser
            return False
        return is_known_viewer_protocol(_messages)

    def on_client(
        self, connect: Callable[[Any], None], disconnect: Callable[[Any], None], refuse: Callable[[int, str], None]
    ) -> None:
        """Set callbacks for opened and closed pages (``viser.ClientHandle``) and refused messages (id, reason)."""
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
    """Return a free port: this one, or any for 0."""
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
