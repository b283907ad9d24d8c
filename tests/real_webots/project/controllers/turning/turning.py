"""Turns its robot."""

from controller import Supervisor

robot = Supervisor()
step = int(robot.getBasicTimeStep())
rotation = robot.getSelf().getField("rotation")
print("The controller runs.", flush=True)
while robot.step(step) != -1:
    rotation.setSFRotation([0, 0, 1, robot.getTime() % 6])
