"""The page's server: viser, on one address of this machine, behind the gate, and quiet."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import socket
import warnings
from collections.abc import Callable
from typing import Any

from neuprim.config.viewer import ViewerSettings
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.viewer.gate import Gate

__all__ = ["PageServer", "is_loopback", "require_viser"]


def require_viser() -> Any:
    """The package viser.

    Raises:
        BackendUnavailable: it is missing.
    """
    try:
        import viser
    except ImportError as error:
        raise BackendUnavailable(
            f"a viewer in the browser needs the package viser ({error}): pip install 'neuprim[viewer]'"
        ) from error
    return viser


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, as seen from itself."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class PageServer:
    """viser, started; ``close`` ends it.

    Attributes:
        viser: the ``ViserServer``.
        address: with the token.
    """

    def __init__(self, settings: ViewerSettings, title: str) -> None:
        """Raises :class:`ConfigError` where host or port are not to be had, :class:`BackendUnavailable` without
        viser."""
        viser = require_viser()
        self._refused_to: Callable[[int, str], None] = lambda client, reason: None
        gate = Gate(settings.host)
        # A page that is closed while something is sent to it is nothing that anybody must be told.
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        port = _free_port(settings.host, settings.port)
        with contextlib.redirect_stdout(io.StringIO()), gate.before_viser(self._refusal, self._refused):
            self.viser = viser.ViserServer(host=settings.host, port=port, label=title, verbose=False)
        if not (gate.stands and self.viser.get_port() == port and self._tunnels_off() and self._messages_known()):
            self.close()
            raise BackendUnavailable(
                f"viser {viser.__version__} did not start behind the check of its visitors, or not on port {port}; "
                "pip install -c constraints.txt 'neuprim[viewer]' has a version that does"
            )
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="large")
        self.viser.scene.configure_environment_map(
            hdri=None
        )  # ellipsoids nearly in their own colours, and not darker below
        self.viser.scene.configure_default_lights(cast_shadow=False)
        self.viser.scene.add_light_ambient("/light", intensity=1.0)
        self.viser.gui.main_panel.dock_right()  # beside the picture, not over it
        self.address = gate.address(settings.host, port)

    def _tunnels_off(self) -> bool:
        """viser can be asked by a page to pass itself on through a server elsewhere; afterwards it cannot. Whether that
        is certain."""
        try:
            from viser import _messages

            for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
                self.viser._websock_server.unregister_handler(kind)
        except (ImportError, AttributeError, AssertionError):  # another viser than those that are known
            return False
        return True

    def _messages_known(self) -> bool:
        from viser import _messages

        from neuprim.viewer.incoming import known

        return known(_messages)

    def on_visit(
        self, come: Callable[[Any], None], gone: Callable[[Any], None], refused: Callable[[int, str], None]
    ) -> None:
        """Be told of every page that is opened and closed, as a ``viser.ClientHandle``, and why a message was refused,
        with a page's number."""
        self._refused_to = refused
        self.viser.on_client_connect(come)
        self.viser.on_client_disconnect(gone)

    def _refusal(self, message: Any) -> str | None:
        from neuprim.viewer.incoming import refusal

        return refusal(message, self._control)

    def _control(self, uuid: str) -> Any:
        guis = (client.gui for client in self.viser.get_clients().values())
        return next(
            (gui._gui_input_handle_from_uuid[uuid] for gui in guis if uuid in gui._gui_input_handle_from_uuid), None
        )

    def _refused(self, connection: Any, reason: str) -> None:
        for number, own in self.viser._websock_server._live_connections.items():
            if own is connection:
                self._refused_to(number, reason)

    def close(self) -> None:
        """Let everybody go, and the port."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()


def _free_port(host: str, port: int) -> int:
    """A port that can be listened on; 0 is any.

    Raises:
        ConfigError: the host is not an address of this machine, or the port is taken.
    """
    try:
        family, kind, number, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except OSError as error:
        raise ConfigError(
            f"viewer at {host}, port {port}: {error.strerror or error}; expected an address of this machine and a free port"
        ) from error
