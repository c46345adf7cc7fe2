"""A policy loop at 50 Hz: waves the first joint of a servo task.

    dimos run streams.yaml            # a blueprint with a servo task, as in docs/rpc.md
    python3 example_policy.py servo_arm --seconds 5

Replace `wave` by your own policy.
"""

import argparse
import math

from dimos_client import Client, DimosError, JointState


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("task", help="the servo task's name")
    arguments.add_argument("--run", help="the run; needed only when several are live")
    arguments.add_argument("--rate", type=float, default=50.0, help="targets per second [Hz]")
    arguments.add_argument("--seconds", type=float, default=5.0, help="how long [s]")
    given = arguments.parse_args()
    home: list[float] = []

    def wave(state: JointState, t: float) -> list[float]:
        """From the joints [rad] and the time [s] to the next positions [rad], one per joint of the task."""
        if not home:  # a stream begins where the arm is
            home.extend(position for position in state.position if position is not None)
        return [home[0] + 0.2 * (1 - math.cos(t)), *home[1:]]

    with Client.connect(given.run) as robot:
        report = robot.follow(given.task, wave, given.rate, given.seconds)
        print(
            f"{report.sent} targets in {report.seconds:.1f} s, {report.missed} missed,"
            f" at worst {report.worst * 1000:.1f} ms late"
        )


if __name__ == "__main__":
    try:
        main()
    except DimosError as error:
        raise SystemExit(f"error: {error}") from None
