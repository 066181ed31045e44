"""Cars that move without a world."""

import math

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
