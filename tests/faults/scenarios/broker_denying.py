"""The access list of the broker does not let the daemon write to its topics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.broker_fixture import MosquittoBroker
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Replace the broker by a mosquitto whose access list permits no writing."""
    rights = gateway.folder / "denying.acl"
    rights.write_text("topic read #\n", "utf-8")
    rights.chmod(0o600)
    denying = MosquittoBroker(gateway.folder, port=gateway.broker.port, more=f"acl_file {rights}\n")
    since = len(gateway.log)
    with gateway.other_broker(denying):
        noticed_s = await gateway.logged("the broker refuses messages on", since)
    recovered_s = await gateway.used("S1", "S2")
    # A denied topic remains in `denied` until its next message. For a rare topic, this takes long,
    # so only the topic `pose` is checked.
    health = gateway.listener.latest
    await gateway.seconds(lambda: "pose" not in health["bridge/health"]["link"]["denied"])
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="broker whose access list denies the topics",
    reported="log; `denied` of the link",
    continues="acquisition, fusion and recording",
    counted="poses; `confirmed` of the link is false",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=1.0,
    missing=MosquittoBroker.missing,
)
