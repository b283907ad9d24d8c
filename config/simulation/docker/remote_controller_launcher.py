"""Runs participant/participant.py, beside this file, as the controller of a robot of Webots.

It connects to Webots before it runs the participant's program: from then on libController sends the output of this
process to Webots' console, also the error if the program can't be read. After the program has ended, with or without
an error, the connection stays and the simulation continues without it. The next reset starts it again.
"""

import ctypes
import os
import runpy
import sys
import traceback

# Output that Webots has not read yet must fit into a pipe.
LONGEST_COMPLAINT = 8000
PROGRAM = os.path.join(os.path.dirname(os.path.abspath(__file__)), "participant", "participant.py")


def connect():
    """Connects to Webots; libController ends this process if that fails.

    A program's own Robot shares the connection.
    """
    # libController asks for these when it connects.
    os.environ.update(WEBOTS_STDOUT_REDIRECT="1", WEBOTS_STDERR_REDIRECT="1")
    home = os.environ.get("WEBOTS_HOME", "/usr/local/webots")
    library = ctypes.CDLL(os.path.join(home, "lib", "controller", "libController.so"))
    library.wb_robot_get_basic_time_step.restype = ctypes.c_double
    library.wb_robot_init()
    return library


def complain(text):
    """Prints the end of a text to Webots' console."""
    print(text[-LONGEST_COMPLAINT:], file=sys.stderr, flush=True)


def run(program):
    """Runs a program as if it had been started directly, and prints why it failed, if it did."""
    folder = os.path.dirname(program)
    os.chdir(folder)
    sys.argv = [program]
    sys.path[0] = folder
    try:
        runpy.run_path(program, run_name="__main__")
    except SystemExit as end:
        if end.code not in (None, 0):
            complain(f"The controller has ended: {end.code}")
    except BaseException as error:  # pylint: disable=broad-except
        trace = error.__traceback__
        while trace and trace.tb_frame.f_code.co_filename != program:
            trace = trace.tb_next
        complain("".join(traceback.format_exception(type(error), error, trace)))
    sys.stdout.flush()


def main():
    """Runs the participant's program, and then keeps the connection until Webots ends it."""
    library = connect()
    step = max(1, int(library.wb_robot_get_basic_time_step()))
    if os.path.isfile(PROGRAM):
        run(PROGRAM)
    else:
        complain("There is no participant/participant.py.")
    while library.wb_robot_step(step) != -1:
        pass


if __name__ == "__main__":
    main()
