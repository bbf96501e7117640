"""The one catalogue of events: every ``kind`` that a process of this project writes to its log, with what it means."""

from __future__ import annotations

from types import MappingProxyType

__all__ = ["KINDS"]

KINDS = MappingProxyType(
    {
        "process.started": "A process joined the bus.",
        "process.ended": "A process ends in order; says after which signal.",
        "child.restarted": "The supervisor starts a process again that had died, or that it killed since it hung.",
        "robot.met": "A service hears a robot for the first time.",
        "robot.began_anew": "A robot speaks with a new epoch: it was started again.",
        "robot.forgotten": "A robot was silent for so long that a service forgets it.",
        "robot.second_refused": "A second robot speaks under a name in use; nothing of it is taken.",
        "message.refused": "What arrived was no message, or came out of order; says why.",
        "filter.fallback_entered": "The safety filter could not decide and brakes; says why.",
        "filter.fallback_left": "The safety filter decides again; says for how many ticks it had not.",
        "filter.disabled": "The safety filter hands wishes on unchecked, since it is switched off.",
        "filter.stopped": "A robot is stopped by an order or by the filter's end.",
        "filter.released": "A robot that was stopped may drive again.",
        "order.taken": "Somebody ordered robots to stop or to go, or switched a source or a zone.",
        "order.refused": "An order was refused; says why.",
        "order.kept": "A filter, or perception, that was started found an order that is still in force.",
        "order.lost": "Perception cannot read the orders that it kept: no source counts until one is switched on.",
        "perception.ignores": "What is seen in the zones named is not told of a robot: by the file, or an order.",
        "perception.source_off": "Sources of a robot are not listened to: by the file, or an order; says which.",
        "perception.source_unknown": "The file of perception names sources that the robot does not have.",
        "perception.switched": "From the tick named on other sources or zones of a robot count; says which.",
        "model.offered": "The diagnosis offers the services a new model of a robot.",
        "model.decided": "All services are ready: from the tick named on the new model is in force.",
        "model.dropped": "An offered model is not taken; says why.",
        "model.ready": "A service loaded the offered model and checked it.",
        "model.taken": "A service uses the new model.",
        "model.refused": "A service cannot use the offered model; says why.",
        "finding.changed": "The diagnosis comes to another stage: raised, searching, candidates, nothing, watching.",
        "recorder.failed": "The recording broke off; says why.",
        "recorder.resumed": "The recording goes on in another file, since the disk has room again.",
        "recorder.lost": "The recorder could not keep up; says how many messages are missing.",
        "router.open": "The router accepts connections.",
        "router.stands": "The router's own work came to a stand; it ends, so that it is started anew.",
        "bus.plain_text": "The bus can be reached from other machines without certificates.",
        "bus.unclosed": "A process ends, and its session with the bus did not close in time; its links end with it.",
        "bus.key_exposed": "A private key can be read by every user of the machine.",
        "bus.astray": "What came under another key than it was sent under, after a lost link, was passed over.",
        "bus.twice": "Two connect with one certificate; one of them may not be who it says.",
        "bus.joined": "Somebody connects to the router with a certificate.",
        "bus.handshake_refused": "Somebody was refused at the router's door.",
        "bus.denied": "Somebody tried what its role may not; the router let nothing through.",
        "bus.too_large": "Somebody sent more bytes than the topic allows; the router let nothing through.",
        "bus.held_back": "Somebody sends more often than any robot ticks; the router lets a part through.",
        "bus.strangers_cut_off": "Connections were ended that did not say in time who they are.",
        "bus.revoked": "Links of certificates that are good for nothing any more were ended.",
        "page.refused": "A page was asked by another page, under another name, without its token, or for too much.",
        "page.wrong_password": "Somebody gave a wrong password to a page.",
        "bus.log_overrun": "More was refused than could be told one by one.",
        "bus.zenoh": "A warning of the network library.",
    }
)
"""By kind: what it means. Kinds are stable: what watches logs may rely on them."""
