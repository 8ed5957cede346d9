"""A server of pages on this machine: viser, without what it prints and without its service that shares pages."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import TYPE_CHECKING, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.system.libraries import missing_library

if TYPE_CHECKING:
    import viser

LOOPBACK: Final = "127.0.0.1"
"""The address that only this machine can reach."""

_PORTS_TRIED: Final = 20
_TAKEN: Final = (errno.EADDRINUSE,)


def free_port(host: str, port: int) -> int:
    """The given port, or the next free one after it. 0: any. Raises BadConfig for a host that is not this machine's,
    or if the next ports are taken, too.
    """
    if not 0 <= port <= 65535:
        raise BadConfig(f"a port must be 0 to 65535, found {port}")
    for number in range(port, min(port + _PORTS_TRIED, 65536)):
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind(address)
                return int(tried.getsockname()[1])
        except socket.gaierror as error:
            raise BadConfig(f"--host must be an address of this machine, found {host!r}: {error.strerror}") from error
        except PermissionError as error:
            raise BadConfig(f"port {number} needs more rights: give a --port of at least 1024") from error
        except OSError as error:
            if error.errno not in _TAKEN:
                raise BadConfig(
                    f"--host must be an address of this machine, found {host!r}: {error.strerror}"
                ) from error
    raise BadConfig(f"ports {port} to {min(port + _PORTS_TRIED, 65536) - 1} of {host} are taken: give another --port")


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """Start a server. title: above the page's controls. Raises BadConfig as `free_port`, MissingLibrary."""
    try:
        import viser
    except ImportError as error:
        raise missing_library("bodyseg view", error, extra="view") from error

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Refuse what would connect this page to a server outside."""
            return None

    chosen = free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()):
        return Server(host=host, port=chosen, label=title, verbose=False)


def close_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
