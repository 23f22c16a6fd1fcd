"""Command `ldo topics`: list the topics of the service, with their producers and consumers."""

import json
from typing import Annotated

from rich.console import Console
from rich.table import Table

from ldo_service.actors.topology import consumers_of, mermaid_diagram, producer_of, topics_table
from ldo_service.schemas.json_schema import json_schema
from ldo_service.schemas.topics import TOPICS

from .options import Robot, argument

WIDTH = 160  # Columns of the table if the output is no terminal, so that no key is truncated.


def topics(
    robot: Robot = "robot",
    json_schema_: Annotated[
        bool,
        argument(name="json-schema", help="print the JSON Schema of every message"),
    ] = False,
    markdown: Annotated[bool, argument(help="print the table of docs/topics.md")] = False,
    mermaid: Annotated[bool, argument(help="print the diagram in Mermaid")] = False,
) -> None:
    """List every topic with its key, message, producer, and consumers with their queue policies.

    The body of a message is a MessagePack map, which any MessagePack library reads. Topics marked *
    also answer a query with their last value.
    """
    if json_schema_:
        print(json.dumps(json_schema(), indent=1))
    elif markdown:
        print(topics_table())
    elif mermaid:
        print(mermaid_diagram())
    else:
        console = Console()
        if not console.is_terminal:
            console.width = WIDTH
        console.print(_table(robot))


def _table(robot: str) -> Table:
    table = Table("topic", "message", "producer", "consumers")
    for topic in TOPICS:
        expression = topic.expression(robot) + ("/<actor>" if topic.is_per_actor else "")
        takers = "\n".join(f"{who} {policy}" for who, policy in consumers_of(topic))
        state = " *" if topic.is_state else ""
        table.add_row(
            expression + state, topic.message.__name__, producer_of(topic), takers or "outside"
        )
    return table
