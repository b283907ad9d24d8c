"""Runs in place of Webots: it sends updates to each client, and closes with 1001 on SIGTERM, as Webots does.

With `--abrupt` it just ends, as a Webots that is killed.
"""

import base64
import hashlib
import os
import signal
import socket
import sys
import threading

GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
UPDATE = b"\x81\x09an update"
clients = []
lock = threading.Lock()


def serve(client):
    head = b""
    while b"\r\n\r\n" not in head:
        received = client.recv(4096)
        if not received:
            return  # the server has looked whether anything listens
        head += received
        if head.startswith(b"CTR"):  # the server asks whether the world is ready
            client.sendall(b"FAILED")
            client.close()
            return
    keys = [line.split(b": ")[1] for line in head.split(b"\r\n") if line.lower().startswith(b"sec-websocket-key")]
    if not keys:
        client.close()
        return
    accept = base64.b64encode(hashlib.sha1(keys[0] + GUID).digest())
    with lock:
        client.sendall(
            b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Accept: " + accept + b"\r\n\r\n"
        )
        clients.append(client)


def end():
    signal.sigwait([signal.SIGTERM])
    with lock:
        for client in [] if "--abrupt" in sys.argv else clients:
            client.sendall(b"\x88\x02\x03\xe9")
        # Within the lock, so that no frame is cut.
        os._exit(0)


def update():
    while True:
        threading.Event().wait(0.01)
        with lock:
            for client in clients:
                client.sendall(UPDATE)


signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
port = next(int(word.split("=")[1]) for word in sys.argv if word.startswith("--port="))
listener = socket.create_server(("127.0.0.1", port))
for task in (end, update):
    threading.Thread(target=task, daemon=True).start()
while True:
    near, _ = listener.accept()
    threading.Thread(target=serve, args=(near,), daemon=True).start()
