"""The table in docs/real-hardware.md is the DBC's."""

import re
from pathlib import Path

import cantools

from dbc.contract import PACKAGED_DBC

PAGE = Path(__file__).parents[2] / "docs/real-hardware.md"


def test_the_table_of_messages_is_that_of_the_dbc():
    row = r"^\| (0x\w+) \| (\w+) \| (\d) \| ([\d-]+) \| (\w+) \| (\w+) \| (.+) \|$"
    described = re.findall(row, PAGE.read_text(), re.M)
    database = cantools.database.load_file(PACKAGED_DBC)
    defined = [
        (
            f"{message.frame_id:#05x}".replace("0x1fff", "0x1FFF"),
            message.name,
            str(message.length),
            str(message.cycle_time or "-"),
            "yes" if message.dbc.attributes.get("E2EProfile2DataIdList") else "no",
            message.senders[0],
            ", ".join(sorted(message.receivers)),
        )
        for message in sorted(database.messages, key=lambda message: message.frame_id)
    ]
    assert described == defined
