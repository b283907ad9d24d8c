"""Lifts the ball once its robot's camera has seen the red wall, which needs OpenGL."""

from controller import Camera, Supervisor

robot = Supervisor()
step = int(robot.getBasicTimeStep())
camera = robot.getDevice("camera")
camera.enable(step)
ball = robot.getFromDef("BALL").getField("translation")
middle = (camera.getWidth(), camera.getWidth() // 2, camera.getHeight() // 2)
is_seen = False
while robot.step(step) != -1:
    image = camera.getImage()
    if image and not is_seen:
        is_seen = Camera.imageGetRed(image, *middle) > 2 * Camera.imageGetGreen(image, *middle)
    if is_seen:
        ball.setSFVec3f([0, 1, robot.getTime() % 2])
