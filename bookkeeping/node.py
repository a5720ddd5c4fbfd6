"""The bookkeeping service's process: one store, asked by the world server alone.

python -m bookkeeping.node DATABASE --run RUN --port PORT --capacity-bytes N [--keep-tags]
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from bookkeeping.sqlite_store import SqliteStore
from bookkeeping.store import Store
from protocol.codec import decoder_of, encode
from protocol.errors import MessageError, StoreError
from protocol.lifeline import tie_to_supervisor
from protocol.messages import (
    SCHEMA_VERSION,
    AnyStoreReply,
    AnyStoreRequest,
    Batch,
    BatchReply,
    Hello,
    HelloReply,
    ReadTags,
    ReadTagsReply,
    StoreRefusal,
)
from protocol.zenoh_link import Link, LinkConfig, credentials_of, run_beside_loop, run_process


def respond(store: Store, request: AnyStoreRequest) -> AnyStoreReply:
    """Do what the world asks of the store."""
    incarnation = request.incarnation
    try:
        match request:
            case Batch():
                return BatchReply(store.apply(request), incarnation)
            case Hello(schema=schema):
                if schema != SCHEMA_VERSION:
                    detail = f"schema {schema}; this store speaks {SCHEMA_VERSION}"
                    return StoreRefusal(detail, incarnation)
                return HelloReply(store.hello(incarnation), incarnation)
            case ReadTags(number=number, places=places):
                return ReadTagsReply(number, store.read(places), incarnation)
    except StoreError as error:
        return StoreRefusal(str(error), incarnation)


def serve(link: Link, store: Store) -> None:
    """Answer the world until the link is closed."""
    decode: Any = decoder_of(AnyStoreRequest)  # type: ignore[arg-type]
    put = link.publisher(link.keys.store_replies)
    inbox = link.inbox(link.keys.store_requests)
    while True:
        payload = inbox.receive_bytes()
        try:
            request = decode(payload)
        except MessageError as error:
            print(f"ignored: {error}", file=sys.stderr)
            continue
        put(encode(respond(store, request)))


async def _main(arguments: argparse.Namespace) -> None:
    with SqliteStore(
        arguments.database,
        run=arguments.run,
        capacity_bytes=arguments.capacity_bytes,
        fresh=not arguments.keep_tags,
        durability=arguments.durability,
        tag_format=arguments.tag_format,
    ) as store:
        config = LinkConfig(
            arguments.run, arguments.port, credentials=credentials_of("bookkeeping")
        )
        with Link(config) as link:
            await run_beside_loop(link, lambda: serve(link, store))


def main() -> None:
    """Run the bookkeeping service's process."""
    tie_to_supervisor()
    parser = argparse.ArgumentParser(prog="bookkeeping.node", description=__doc__)
    parser.add_argument("database", type=Path, help="SQLite file")
    parser.add_argument("--run", required=True, help="name of the run")
    parser.add_argument("--port", type=int, required=True, help="port of the router")
    parser.add_argument("--capacity-bytes", type=int, required=True, help="size of a tag")
    parser.add_argument("--tag-format", default="", help="what the bytes of a tag mean")
    parser.add_argument("--keep-tags", action="store_true", help="start on an earlier run's tags")
    parser.add_argument("--durability", choices=("process", "power"), default="process")
    arguments = parser.parse_args()
    run_process("bookkeeping", _main(arguments))


if __name__ == "__main__":
    main()
