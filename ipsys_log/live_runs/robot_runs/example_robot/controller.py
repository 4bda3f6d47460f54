"""The controller of the robot, with two PID controllers: replace it by your own."""

from math import atan2, cos, hypot, pi, remainder

FASTEST_M_S, TRACK_M = 0.26, 0.287  # of a wheel; distance of the wheels
ARRIVED_M, LEFT_M, HOLD_S, LOST_S = 0.008, 0.014, 1.5, 0.5
TURN_RAD, BACK_M = 0.35, 0.15


class Pid:
    """A PID controller: the output is limited, and the integral does not grow while it is at the limit."""

    def __init__(self, p, i, d, limit):
        self.p, self.i, self.d, self.limit = p, i, d, limit
        self.sum, self.last = 0.0, None

    def step(self, error, time_s):
        seconds, slope = 0.0, 0.0
        if self.last is not None and 0 < time_s - self.last[1] < 1:
            seconds = time_s - self.last[1]
            slope = (error - self.last[0]) / seconds
        self.last = error, time_s
        output = self.p * error + self.i * (self.sum + error * seconds) + self.d * slope
        if abs(output) < self.limit:
            self.sum += error * seconds
        return max(-self.limit, min(self.limit, output))


class Controller:
    """Drives through the waypoints, and stands at each for HOLD_S."""

    def __init__(self, waypoints):
        self.waypoints, self.number = waypoints, 0
        self.since_s, self.last, self.wheels = None, None, (0.0, 0.0)
        self.speed, self.turn = Pid(0.8, 0.0, 0.0, FASTEST_M_S), Pid(1.4, 0.02, 0.02, 1.0)

    def step(self, pose, now_s):
        """Return the speeds of the wheels in m/s, and the state."""
        if pose is None or now_s - pose.arrival_s > LOST_S:
            self.last, self.wheels = None, (0.0, 0.0)
            return self.wheels, "stopped"
        if pose is not self.last:  # between two positions, the wheels keep their speeds
            self.last, self.wheels = pose, self.follow(pose, now_s)
        is_last = self.number == len(self.waypoints) - 1
        held_s = 0.0 if self.since_s is None else now_s - self.since_s
        if held_s > HOLD_S and not is_last:
            self.number, self.since_s = self.number + 1, None
        state = (
            "driving" if self.since_s is None else "finished" if is_last and held_s > HOLD_S else "holding"
        )
        return self.wheels, state

    def follow(self, pose, now_s):
        goal_x_m, goal_y_m = self.waypoints[self.number]
        x_m, y_m = goal_x_m - pose.x_m, goal_y_m - pose.y_m
        left_m = hypot(x_m, y_m)
        if left_m < (ARRIVED_M if self.since_s is None else LEFT_M):
            self.since_s = now_s if self.since_s is None else self.since_s
            return 0.0, 0.0
        self.since_s = None
        angle_rad = remainder(atan2(y_m, x_m) - pose.heading_rad, 2 * pi)
        if abs(angle_rad) > pi / 2 and left_m < BACK_M:  # a short way back: without turning round
            angle_rad, left_m = remainder(angle_rad + pi, 2 * pi), -left_m
        forward = self.speed.step(left_m, pose.time_s) * cos(angle_rad) if abs(angle_rad) < TURN_RAD else 0.0
        turn = self.turn.step(angle_rad, pose.time_s) * TRACK_M / 2
        scale = min(1.0, FASTEST_M_S / max(abs(forward) + abs(turn), 1e-9))
        return (forward - turn) * scale, (forward + turn) * scale
