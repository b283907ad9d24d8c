"""Stand-ins for simulation servers with many simulations, which tell session servers of their fleet about these."""

import asyncio
import contextlib
import json
import threading

from websockets.asyncio.server import serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response


class RosterServer:
    """A server with these simulations, each with its name and world; a context manager."""

    def __init__(self, number, simulations):
        self.number = number
        self.simulations = {
            f"20261124T0900{index:02}000-{number}{index}": {"label": name, "world": world}
            for index, (name, world) in enumerate(simulations)
        }
        self.reasons = {}
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)

    def __enter__(self):
        self.thread.start()
        self.server = asyncio.run_coroutine_threadsafe(self.start(), self.loop).result()
        self.address = f"127.0.0.1:{self.server.sockets[0].getsockname()[1]}"
        return self

    def __exit__(self, *_):
        async def stop():
            self.server.close()
            await self.server.wait_closed()

        asyncio.run_coroutine_threadsafe(stop(), self.loop).result()
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()

    async def start(self):
        return await serve(self.link, "127.0.0.1", 0, process_request=self.request)

    def request(self, _, request):
        if request.path == "/slots":
            return None
        report = {"load": 5, "version": "stand-in", "docker": False, "reserves": True}
        report["instances"] = {"running": len(self.simulations), "places": 100}
        status, body = ("200 OK", json.dumps(report).encode()) if request.path == "/status" else ("404 Not Found", b"")
        code, reason = status.split(" ", 1)
        return Response(int(code), reason, Headers({"Content-Length": str(len(body))}), body)

    async def link(self, socket):
        await socket.send(json.dumps({"challenge": 1, "server": self.number, "pass": 10, "roster": True}))
        await socket.recv()
        await socket.send(json.dumps({"number": 0, "offers": [], "free": 0}))
        # The session server may leave without a closing handshake.
        with contextlib.suppress(ConnectionClosed):
            async for text in socket:
                message = json.loads(text)
                if "follow" in message:
                    await self.tell_all(socket)
                elif "stop" in message:
                    await self.stop(socket, **message["stop"])

    async def tell_all(self, socket):
        simulations = [
            {"id": one, "state": "running", "since": 1_764_000_000, **more} for one, more in self.simulations.items()
        ]
        await socket.send(json.dumps({"roster": {"all": True, "simulations": simulations, "ended": []}}))

    async def stop(self, socket, number, ids, reason, by):
        stopped = [one for one in ids if self.simulations.pop(one, None)]
        self.reasons.update(dict.fromkeys(stopped, (reason, by)))
        await socket.send(json.dumps({"stopped": {"number": number, "ids": stopped}}))
        await socket.send(json.dumps({"roster": {"all": False, "simulations": [], "ended": stopped}}))
