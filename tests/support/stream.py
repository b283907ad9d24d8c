"""Hands connections on from the port that Webots is given to another one: --port=N, and the other port last."""

import contextlib
import socket
import sys
import threading


def copy(source, target):
    try:
        while data := source.recv(65536):
            target.sendall(data)
    except OSError:
        pass
    for one in (source, target):
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)


def serve(near):
    begin = near.recv(3, socket.MSG_PEEK)
    if begin == b"CTR":  # the server asks whether the world is ready
        near.recv(4096)
        near.sendall(b"FAILED")
        near.close()
    elif begin:  # else the server has looked whether anything listens
        far = socket.create_connection(("127.0.0.1", other))
        threading.Thread(target=copy, args=(near, far), daemon=True).start()
        copy(far, near)


port = next(int(word.split("=")[1]) for word in sys.argv if word.startswith("--port="))
other = int(sys.argv[-1])
listener = socket.create_server(("127.0.0.1", port), backlog=128)
while True:
    near, _ = listener.accept()
    threading.Thread(target=serve, args=(near,), daemon=True).start()
