"""Drives its robot in a circle through the place it starts from.

Webots runs this; the demo simulator runs no controllers and moves the robots by itself. The robots have no
motors, so the controller, as a supervisor, sets their pose. It is computed from the simulation time alone:
after a reset the robot is back at its start.
"""

import math

from controller import Supervisor

SPEED = 0.25  # metres per second
RADIUS = 0.4  # metres

robot = Supervisor()
node = robot.getSelf()
translation = node.getField("translation")
rotation = node.getField("rotation")
x, y, z = translation.getSFVec3f()
heading = rotation.getSFRotation()[3]

while robot.step(int(robot.getBasicTimeStep())) != -1:
    angle = heading + SPEED / RADIUS * robot.getTime()
    translation.setSFVec3f(
        [
            x + RADIUS * (math.sin(angle) - math.sin(heading)),
            y - RADIUS * (math.cos(angle) - math.cos(heading)),
            z,
        ]
    )
    rotation.setSFRotation([0, 0, 1, angle])
