"""Who may connect, and who may change anything: this machine alone, unless the operator says otherwise."""

import hmac
import ipaddress
from dataclasses import dataclass, field

from ...factors.errors import SurecutError

MINIMUM_TOKEN = 16


class AccessError(SurecutError):
    """A server was asked to listen where it may not."""


@dataclass(frozen=True, slots=True)
class Access:
    """Where a server listens, and what it asks for.

    Args:
        host: address to listen on.
        allow_remote: must be set for any address that other machines can reach.
        token: what a command has to bring along. Without one, commands are taken on this machine only.

    Raises:
        AccessError: the address is reachable from elsewhere and that was not allowed, or the token is too short.
    """

    host: str = "127.0.0.1"
    allow_remote: bool = False
    token: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not self.is_local and not self.allow_remote:
            raise AccessError(
                f"{self.host}: other machines could connect to this address; allow that explicitly, or use 127.0.0.1"
            )
        if self.token is not None and len(self.token) < MINIMUM_TOKEN:
            raise AccessError(f"the token has {len(self.token)} characters; use at least {MINIMUM_TOKEN}")

    @property
    def is_local(self) -> bool:
        """Whether only this machine can connect."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def takes_commands(self) -> bool:
        """Whether anything may be changed through this server at all."""
        return self.is_local or self.token is not None

    def authorises(self, given: object) -> bool:
        """Whether a command that brings `given` along may be carried out; takes the same time for any wrong one."""
        if self.token is None:
            return self.is_local
        return isinstance(given, str) and hmac.compare_digest(given.encode(errors="replace"), self.token.encode())


def cannot_listen(host: str, port: int, error: OSError) -> AccessError:
    """What to raise when an address is in use or is none of this machine."""
    return AccessError(f"{host}:{port}: cannot listen there ({error.strerror or error}); choose another port")
