"""A burst is kept whole; what a slow broker holds up is not."""

from __future__ import annotations

from gateway.outputs.queues import LONGEST_BURST, LONGEST_HOLD_S, PoseQueue


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def queue_of(length=4, has_broker=True):
    clock = Clock()
    queue = PoseQueue(length, clock)
    queue.has_broker = has_broker
    return queue, clock


def test_a_burst_is_kept_up_to_its_bound_however_late_it_comes():
    queue, clock = queue_of()
    for k in range(LONGEST_BURST):
        clock.now_s += 1.0  # nobody waits for the broker meanwhile
        queue.put(k)
    assert (len(queue), queue.dropped) == (LONGEST_BURST, 0)
    queue.put(LONGEST_BURST)
    assert (len(queue), queue.dropped) == (LONGEST_BURST, 1)
    assert queue.take() == 1


def test_while_the_broker_takes_nothing_only_the_newest_are_kept():
    queue, clock = queue_of()
    with queue.waiting_for_broker():
        for k in range(100):
            clock.now_s += 0.01
            queue.put(k)
            assert len(queue) <= max(4, LONGEST_HOLD_S / 0.01 + 2)
        assert [queue.take() for _ in range(4)] == [96, 97, 98, 99]
    assert queue.dropped == 96


def test_a_broker_that_is_slow_with_each_pose_does_not_lengthen_the_queue():
    queue, clock = queue_of()
    longest = 0
    for k in range(0, 1000, 5):
        for one in range(5):
            queue.put(k + one)
        longest = max(longest, len(queue))
        queue.take()
        with queue.waiting_for_broker():
            clock.now_s += 0.05
    assert longest <= 15
    assert queue.dropped > 700


def test_of_a_burst_the_newest_are_kept_when_the_broker_is_lost():
    queue, _ = queue_of()
    for k in range(9):
        queue.put(k)
    queue.has_broker = False
    assert [queue.take() for _ in range(len(queue))] == [5, 6, 7, 8]
    assert queue.dropped == 5


def test_without_a_broker_only_the_newest_are_kept_and_on_request_the_last():
    queue, _ = queue_of(has_broker=False)
    for k in range(10):
        queue.put(k)
    assert (len(queue), queue.dropped) == (4, 6)
    queue.keep_newest()
    assert (queue.take(), queue.dropped) == (9, 9)
