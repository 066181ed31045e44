"""Cars that move without a world."""

import math

from pytest_pafot import Drive, Observation

HZ = 15


def moved(car, acceleration=0.0, steering=0.0):
    """Move a car by one tick of highway-env's bicycle model."""
    slip = math.atan(math.tan(steering) / 2)
    y = car.y + car.speed * math.sin(car.heading + slip) / HZ
    return car._replace(
        x=car.x + car.speed * math.cos(car.heading + slip) / HZ,
        y=y,
        heading=car.heading + car.speed * math.sin(slip) / (car.length / 2) / HZ,
        speed=max(car.speed + acceleration / HZ, 0.0),
        lane=round(y / 4.0),
    )


def drive(seconds, *others, ego, ads, lanes=3):
    """Return the ego and the others, which keep their speed, after a time without contact."""
    action = (0.0, 0.0)
    for tick in range(round(seconds * HZ)):
        if tick % 3 == 0:
            seen = Observation(tick / HZ, ego, others, lanes, 4.0, 26.8, acceleration=action[0], steering=action[1])
            answer = ads(seen)
            action = (answer.acceleration, 0.0) if isinstance(answer, Drive) else answer
        ego, others = moved(ego, *action), tuple(map(moved, others))
        assert not any(abs(ego.x - o.x) < 5.0 and abs(ego.y - o.y) < 2.0 for o in others), "contact"
    return ego, others
