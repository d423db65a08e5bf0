"""Sends goals to Nav2's action `NavigateToPose`, follows them by its feedback, and cancels them."""

from functools import partial
from threading import RLock

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.task import Future


class Navigator:
    """One goal at a time: a new one takes the place of the one before.

    `state` is `idle` before the first goal and after a cancel, then `waiting` until Nav2 takes the
    goal, `driving`, and in the end `arrived` or `failed`.
    """

    def __init__(self, node, action: str, callback_group) -> None:
        """Does not wait for Nav2: ask `is_ready` before a goal."""
        self._client = ActionClient(node, NavigateToPose, action, callback_group=callback_group)
        self._logger, self._name = node.get_logger(), action
        self._number, self._handle = 0, None
        self._unanswered: set[Future] = set()
        self.lock = RLock()  # Nav2's answers come while another thread sends or cancels
        self.state, self.remaining, self.recoveries = "idle", None, 0

    @property
    def is_busy(self) -> bool:
        """True while the robot is on its way."""
        return self.state in ("waiting", "driving")

    def is_ready(self) -> bool:
        """True if Nav2 is up; says so if it is not."""
        is_up = self._client.server_is_ready()
        if not is_up:
            self._logger.warning(
                f"no action server {self._name}: is Nav2 running?", throttle_duration_sec=5.0
            )
        return is_up

    @property
    def is_settled(self) -> bool:
        """True if Nav2 has answered every request."""
        return not self._unanswered

    def go(self, pose: PoseStamped) -> None:
        """Sends a goal."""
        with self.lock:
            self._drop()
            self.state, self.remaining, self.recoveries = "waiting", None, 0
            sent = self._client.send_goal_async(
                NavigateToPose.Goal(pose=pose),
                feedback_callback=partial(self._on_feedback, self._number),
            )
            sent.add_done_callback(partial(self._on_answer, self._number))
            self._await(sent)

    def cancel(self) -> None:
        """Stops the robot on its way; nothing without a goal."""
        with self.lock:
            self._drop()
            self.state = "idle"

    def give_up(self, why: str) -> None:
        """Cancels a goal that counts as failed."""
        with self.lock:
            self._drop()
            self.state = "failed"
        self._logger.warning(f"goal given up: {why}")

    def _drop(self) -> None:
        # What is still to come of the goal before carries its number, and is ignored.
        self._number += 1
        handle, self._handle = self._handle, None
        if handle is not None:
            self._await(handle.cancel_goal_async())

    def _await(self, answer: Future) -> None:
        self._unanswered.add(answer)
        answer.add_done_callback(self._unanswered.discard)

    def _on_answer(self, number: int, future: Future) -> None:
        handle = future.result()
        with self.lock:
            if number != self._number:
                if handle.accepted:  # canceled before Nav2 had answered
                    self._await(handle.cancel_goal_async())
            elif handle.accepted:
                self.state, self._handle = "driving", handle
                handle.get_result_async().add_done_callback(partial(self._on_result, number))
            else:
                self.state = "failed"
                self._logger.warning("Nav2 refused the goal")

    def _on_feedback(self, number: int, message) -> None:
        if number == self._number:
            self.remaining = float(message.feedback.distance_remaining)
            self.recoveries = int(message.feedback.number_of_recoveries)

    def _on_result(self, number: int, future: Future) -> None:
        with self.lock:
            if number != self._number:
                return
            status, self._handle = future.result().status, None
            self.state = "arrived" if status == GoalStatus.STATUS_SUCCEEDED else "failed"
        if self.state == "failed":
            self._logger.warning(f"Nav2 gave the goal up (status {status})")
