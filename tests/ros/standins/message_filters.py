"""A stand-in for ROS 2's message_filters, which PyPI lacks: real subscriptions, pairs by stamp."""

from collections import deque

from r3jax.formats.ros.messages import stamp_of


class Subscriber:
    """A subscription that a synchronizer listens to."""

    def __init__(self, node, kind, topic, **options):
        self.callback = None
        node.create_subscription(kind, topic, lambda one: self.callback(one), **options)


class ApproximateTimeSynchronizer:
    """Pairs of messages whose stamps differ by no more than the slop [s]."""

    def __init__(self, subscribers, queue_size, slop):
        self.slop, self.callback = slop * 1e9, None
        self.waiting = [deque(maxlen=queue_size) for _ in subscribers]
        for number, one in enumerate(subscribers):
            one.callback = lambda message, number=number: self._take(number, message)

    def registerCallback(self, callback):
        self.callback = callback

    def _take(self, number, message):
        others = self.waiting[1 - number]
        for other in others:
            if abs(stamp_of(other) - stamp_of(message)) <= self.slop:
                others.remove(other)
                self.callback(*((message, other) if number == 0 else (other, message)))
                return
        self.waiting[number].append(message)
