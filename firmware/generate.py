"""Write ``core/protocol.h`` from ``amiwarp.live.link.protocol``, so that both ends of the link have one description.

``python generate.py`` writes the file; ``python generate.py --check`` ends with status 1 if it is out of date.
"""

import re
import struct
import sys
from dataclasses import fields
from pathlib import Path

from amiwarp.live.link import protocol

HEADER = Path(__file__).parent / "core" / "protocol.h"


def name(text: str) -> str:
    """Return a message, field or fault name as the name of a macro."""
    spaced = "".join(f"_{c}" if c.isupper() and k else c for k, c in enumerate(text))
    return spaced.replace(" ", "_").replace("-", "_").upper()


def described() -> str:
    """Return the text of the header file."""
    lines = [
        "/* Protocol of the serial link, docs/reference/link-protocol.md. Written by generate.py from",
        "   amiwarp/live/link/protocol.py: do not edit. Offsets are those in the payload [bytes]. */",
        "#ifndef PROTOCOL_H",
        "#define PROTOCOL_H",
        "",
        f"#define PROTOCOL_VERSION {protocol.VERSION}",
        f"#define LONGEST_FRAME {protocol.LONGEST}",
        f"#define MOST_SAMPLES {protocol.MOST_SAMPLES}",
        *(
            f"#define {which}_PULSE_MS {ms}u"
            for which, ms in zip(("LEAST", "MOST"), protocol.PULSE_INTERVAL_MS, strict=True)
        ),
        f"#define SAMPLES_TYPE 0x{protocol.Samples.KIND:02X}",
        "#define SAMPLE_BYTES 8",
    ]
    for message in protocol.PLAIN:
        prefix = name(message.__name__)
        lines += [
            "",
            f"#define {prefix}_TYPE 0x{message.KIND:02X}",
            f"#define {prefix}_BYTES {message.LAYOUT.size}",
        ]
        layout = re.findall(r"\d*[A-Za-z]", message.LAYOUT.format)
        for k, field in enumerate(fields(message)):
            offset = struct.calcsize("<" + "".join(layout[:k]))
            lines.append(f"#define {prefix}_{name(field.name)} {offset} /* {layout[k]} */")
    settings = tuple(setting.name for setting in protocol.SETTINGS)
    for prefix, names in (
        ("STATE", protocol.STATES), ("FAULT_BIT", protocol.FAULTS), ("REFUSED", protocol.REFUSALS),
        ("SETTING", settings),
    ):  # fmt: skip
        lines += ["", *(f"#define {prefix}_{name(text)} {k}" for k, text in enumerate(names))]
    lines += ["", "/* Smallest and largest value of each setting, and whether 0 is allowed too. */"]
    ranges = (
        f"    {{{setting.least}, {setting.most}, {int(setting.off)}}},"
        for setting in protocol.SETTINGS
    )
    lines += [
        " \\\n".join(["#define SETTING_RANGES", *ranges]),
        f"#define SETTINGS {len(settings)}",
    ]
    lines += [
        "",
        f"#define UNKNOWN_MV {protocol.UNKNOWN_MV}u",
        f"#define BOARD_BYTES {protocol.BOARD_BYTES}",
    ]
    return "\n".join([*lines, "", "#endif", ""])


if __name__ == "__main__":
    if "--check" in sys.argv:
        if HEADER.read_text() != described():
            sys.exit(
                f"{HEADER}: differs from amiwarp/live/link/protocol.py; run: python {__file__}"
            )
    else:
        HEADER.write_text(described())
