"""A small simulator, which is code of the user's: it puts each vehicle where its control says."""

from pytest_pafot import Simulator


class Puppets(Simulator):
    def start(self, vehicles, seed):
        self.cars = [[each.x, each.y, each.heading, each.speed] for each in vehicles]

    def step(self, controls):
        self.cars = [[each.x, each.y, each.heading, each.speed] for each in controls]

    def states(self):
        return self.cars
