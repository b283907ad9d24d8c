"""A real SMTP server on a loopback port. Tells on standard output, one JSON object a line, what happens:

{"port": 40001}                                          it listens
{"opened": true}, {"closed": true}                       a connection
{"command": "AUTH", "encrypted": false}                  each command
{"mail": {"from", "to", "headers", "text", "encrypted", "raw"}}

It ends when its standard input does.
"""

import argparse
import asyncio
import email
import email.policy
import json
import os
import ssl
import sys
import threading

import trustme
from aiosmtpd.smtp import SMTP, AuthResult


def tell(**what):
    print(json.dumps(what), flush=True)


class TellingServer(SMTP):
    """Tells every command and connection."""

    def connection_made(self, transport):
        # The second call is the one for the encrypted stream of the same connection.
        if not getattr(self, "told", False):
            self.told = True
            tell(opened=True)
        super().connection_made(transport)

    def connection_lost(self, error):
        tell(closed=True)
        super().connection_lost(error)


def telling(name):
    method = getattr(SMTP, name)

    async def tell_and_do(self, argument):
        encrypted = self.transport.get_extra_info("sslcontext") is not None
        tell(command=name.removeprefix("smtp_"), encrypted=encrypted)
        return await method(self, argument)

    for attribute in vars(method):
        setattr(tell_and_do, attribute, getattr(method, attribute))
    return tell_and_do


for name in [name for name in dir(SMTP) if name.startswith("smtp_")]:
    setattr(TellingServer, name, telling(name))


class Handler:
    def __init__(self, options):
        self.options = options

    async def handle_RCPT(self, server, session, envelope, address, rcpt_options):
        if self.options.refuse == "recipient":
            return "550 5.1.1 no such user here"
        envelope.rcpt_tos.append(address)
        return "250 OK"

    async def handle_DATA(self, server, session, envelope):
        if self.options.refuse == "mail":
            return "451 4.3.0 try again later"
        message = email.message_from_bytes(envelope.content, policy=email.policy.default)
        parts = {part.get_content_type(): part.get_content() for part in message.walk() if not part.is_multipart()}
        tell(
            mail={
                "from": envelope.mail_from,
                "to": envelope.rcpt_tos,
                "headers": [[name, str(value)] for name, value in message.items()],
                "text": parts.get("text/plain"),
                "encrypted": server.transport.get_extra_info("sslcontext") is not None,
                "raw": envelope.content.decode("utf-8", "replace"),
            }
        )
        return "250 2.0.0 OK: queued"

    async def handle_QUIT(self, server, session, envelope):
        if self.options.hang == "quit":
            await asyncio.Event().wait()
        return "221 Bye"


class Mute(asyncio.Protocol):
    """Accepts a connection and says nothing."""

    def connection_made(self, transport):
        tell(opened=True)

    def connection_lost(self, error):
        tell(closed=True)


def certificate(options):
    authority = trustme.CA()
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    authority.issue_cert(*options.names.split(",")).configure_cert(context)
    if options.authority:
        authority.cert_pem.write_to_path(options.authority)
    return context


def server_of(options, context):
    def authenticate(server, session, envelope, mechanism, data):
        login = f"{data.login.decode()}:{data.password.decode()}"
        return AuthResult(success=login == options.login, handled=login == options.login)

    if options.hang == "greeting":
        return Mute()
    return TellingServer(
        Handler(options),
        hostname="localhost",
        tls_context=context if options.tls == "starttls" else None,
        auth_required=options.login is not None,
        auth_require_tls=options.tls == "starttls",
        authenticator=authenticate,
    )


async def serve(options):
    context = certificate(options) if options.tls != "none" else None
    server = await asyncio.get_running_loop().create_server(
        lambda: server_of(options, context),
        "127.0.0.1",
        options.port,
        ssl=context if options.tls == "implicit" else None,
    )
    tell(port=server.sockets[0].getsockname()[1])
    await server.serve_forever()


def end_with_input():
    sys.stdin.read()
    os._exit(0)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--tls", choices=["none", "starttls", "implicit"], default="none")
    parser.add_argument("--names", default="localhost,127.0.0.1", help="whom the certificate is for")
    parser.add_argument("--authority", help="where to write the certificate of the authority")
    parser.add_argument("--login", help="USER:PASSWORD that is required")
    parser.add_argument("--refuse", choices=["recipient", "mail"])
    parser.add_argument("--hang", choices=["greeting", "quit"])
    threading.Thread(target=end_with_input, daemon=True).start()
    asyncio.run(serve(parser.parse_args()))


main()
