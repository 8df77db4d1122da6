"""From bytes that somebody sent to a message that is delivered: decoded, let in or counted, never fatal."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import zstandard

from ...factors.errors import LogError
from ..decode import ChannelInfo, Decoder, decoder_for
from ..messages import CameraInfoBody, OtherBody
from .admission import Admission, Expected, Limits
from .definitions import UnknownTypeError, with_own_definition
from .interfaces import Clock, Deliver
from .tally import Tally

_ZSTD = b"\x28\xb5\x2f\xfd"
_MAXIMUM_NAME = 256


class Intake:
    """The way in of one source; called from that source's thread alone, apart from the counters.

    Args:
        clock: gives `log_time_ns`.
        expected: types by topic, see `expected.expected_bodies`; None: everything that front ends can use.
    """

    def __init__(self, clock: Clock, expected: Expected | None = None, limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self.tally = Tally()
        self._clock = clock
        self._admission = Admission(expected, self.limits)
        self._decoders: OrderedDict[ChannelInfo, Decoder | str] = OrderedDict()
        self._deliver: Deliver | None = None
        self._last_problem = ""

    def open(self, deliver: Deliver) -> None:
        """Where messages go from now on."""
        self._deliver = deliver

    def close(self) -> None:
        """Deliver nothing more."""
        self._deliver = None

    def wanted(self, topic: str) -> bool:
        """Whether anybody asked for the topic."""
        return self._admission.wanted(topic)

    def accepts(self, channel: ChannelInfo) -> bool:
        """Whether it is worth asking for a channel; counts what cannot be understood, once."""
        if not self.wanted(channel.topic) or len(channel.topic) > _MAXIMUM_NAME:
            return False
        decoder = self._decoder(channel)
        if isinstance(decoder, str):
            self.tally.add(decoder, channel.topic)
        return not isinstance(decoder, str)

    def forget_senders(self) -> None:
        """The link was opened anew: whoever sent on a topic may have another name now."""
        self._admission.forget_senders()

    def take(self, channel: ChannelInfo, data: bytes, sender: str = "", sent_ns: int = 0) -> None:
        """One message as it came. Never raises.

        Args:
            sender: tells the publishers of one topic apart.
            sent_ns: when it was sent or recorded, where the transport says so: then stamps are compared with that, so
                that a recording may be sent faster than it was made.
        """
        deliver = self._deliver
        if deliver is None:
            return
        topic = channel.topic[:_MAXIMUM_NAME]
        self.tally.add("received", topic)
        received_ns = self._clock()
        try:
            reason = self._handle(deliver, channel, data, sender, received_ns, sent_ns or received_ns)
        except LogError as error:
            reason = "malformed"
            self._last_problem = str(error)
        except Exception as error:  # whatever a stranger's bytes provoke must not end the stream
            reason = "undeliverable"
            self._last_problem = f"{topic}: {type(error).__name__}: {error}"
        self.tally.add(reason, topic)

    def refuse(self, reason: str, topic: str | None = None, problem: str = "") -> None:
        """Count something that never became a message."""
        self.tally.add("received", topic)
        self.tally.add(reason, topic)
        self._last_problem = problem or self._last_problem

    def last_problem(self) -> str:
        """What was wrong with the last message that was malformed; empty if none was."""
        return self._last_problem

    def counters(self) -> Mapping[str, int]:
        """See `interfaces.Source`."""
        return self.tally.totals()

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        """See `interfaces.Source`."""
        return self.tally.by_topic()

    def _handle(
        self, deliver: Deliver, channel: ChannelInfo, data: bytes, sender: str, received_ns: int, sent_ns: int
    ) -> str:
        if len(data) > self.limits.message_bytes or len(channel.topic) > _MAXIMUM_NAME or self._is_bomb(data):
            return "oversized"
        if not self.wanted(channel.topic):
            return "ignored"
        decoder = self._decoder(channel)
        if isinstance(decoder, str):
            return decoder
        message = decoder(data, received_ns)
        if isinstance(message.body, OtherBody):
            return "unknown_type"
        reason = self._admission.refusal(message, sender, sent_ns)
        if reason is not None:
            return reason
        if isinstance(message.body, CameraInfoBody) and abs(message.stamp_ns - sent_ns) > self.limits.stamp_error_ns:
            message = replace(message, stamp_ns=0)  # some drivers stamp a calibration once and send it for ever
        deliver(message)
        return "delivered"

    def _is_bomb(self, data: bytes) -> bool:
        """Whether a compressed message says that it is too large, or does not say how large it is."""
        if data[:4] != _ZSTD:
            return False
        try:
            return not 0 <= zstandard.frame_content_size(data[:18]) <= self.limits.message_bytes
        except zstandard.ZstdError:
            return True

    def _decoder(self, channel: ChannelInfo) -> Decoder | str:
        known = self._decoders.get(channel)
        if known is not None:
            self._decoders.move_to_end(channel)
            return known
        try:
            made: Decoder | str = decoder_for(with_own_definition(channel))
        except UnknownTypeError as error:
            made, self._last_problem = "unknown_type", str(error)
        except LogError as error:
            made, self._last_problem = "unknown_encoding", str(error)
        self._decoders[channel] = made
        if len(self._decoders) > self.limits.channels:
            self._decoders.popitem(last=False)
        return made
