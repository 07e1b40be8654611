"""Malformed files: small sound ones, and ways to damage them."""

from __future__ import annotations

import random
import re

#: Cells and numbers that readers of text stumble over.
NASTY = (
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e18",
    "-9e18",
    "9" * 40,
    "",
    "word",
    "-0",
    "0",
    "1e-320",
    "0x10",
    " ",
    "\x00",
    "'",
    '"',
    "é",
    "#",
    "1;2",
    "None",
    "true",
    "1e9",
    "2147483648",
    "-1",
    "../../x",
    "1,5",
    "%s",
    "\ufeff",
    "1e400",
    "\r",
    "9" * 400,
    "x" * 5000,
    "\x1b[31m",
    "\x9b",
    "\u202e",
    "2000-01-01",
    "=1+1",
    "1e15",
    "inf" * 900,
)

_TOKEN = re.compile(rb"[^\s,\[\]{}:]+")


#: Parts of formulas, and of what is none.
_PARTS = (
    "(",
    ")",
    "()",
    "*",
    "**",
    "/",
    "-",
    "+",
    ",",
    ".",
    "[",
    "]",
    "{",
    "}",
    "'",
    '"',
    ":",
    ":=",
    "=",
    "==",
    "@",
    "%",
    "lambda",
    "if",
    "else",
    "for",
    "in",
    "await",
    "yield",
    "import",
    "eval",
    "__import__",
    "__class__",
    "os",
    "os.system",
    "exec",
    "open",
    "law",
    "law(gap=gap)",
    "NN",
    "gap",
    "x_2",
    "v",
    "t",
    "exp",
    "log",
    "max(",
    "1e400",
    "9**9**9",
    "0",
    "1j",
    "0x1F",
    "True",
    "None",
    "...",
    "\\",
    "\n",
    "\x00",
    "é",
    "_",
    "\ud800",
)


def damaged_formula(content: bytes, rng: random.Random) -> bytes:
    """Tokens of a formula repeated, swapped, nested, or strange ones in their place."""
    tokens = re.findall(r"\w+|\S", content.decode())
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(tokens))
        match rng.randrange(6):
            case 0:
                tokens[at] = rng.choice(_PARTS)
            case 1:
                tokens.insert(at, rng.choice(_PARTS))
            case 2:
                tokens.insert(at, tokens[rng.randrange(len(tokens))])
            case 3:
                other = rng.randrange(len(tokens))
                tokens[at], tokens[other] = tokens[other], tokens[at]
            case 4:
                number = rng.choice((5, 60, 300, 3000))
                tokens[at] = rng.choice(("(", "-", "exp(")) * number + tokens[at] + ")" * number
            case _:
                tokens = tokens[at:] + tokens[:at]
    return " ".join(tokens).encode("utf-8", "surrogatepass")


def damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    """One to three of: flipped bits, cut, inserted, repeated, zeroed, dropped bytes."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 3)):
        if not data:
            break
        at = rng.randrange(len(data))
        size = min(rng.choice((1, 2, 4, 16, 64)), len(data) - at)
        match rng.randrange(7):
            case 0:
                for _ in range(rng.choice((1, 2, 8))):
                    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            case 1:
                del data[at:]
            case 2:
                data[at:at] = rng.randbytes(size)
            case 3:
                data[at:at] = data[at : at + size]
            case 4:
                data[at : at + size] = bytes(size)
            case 5:
                del data[at : at + size]
            case _:
                # sizes and offsets of binary formats
                number = rng.choice((0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 24, 1 << 31))
                data[at : at + 4] = number.to_bytes(4, rng.choice(("little", "big")))
    return bytes(data)


def damaged_text(content: bytes, rng: random.Random) -> bytes:
    """One to four of: a strange cell, a line lost, doubled, cut or moved, another separator."""
    lines = content.split(b"\n")
    for _ in range(rng.randint(1, 4)):
        if not lines:
            break
        at = rng.randrange(len(lines))
        match rng.randrange(8):
            case 0 | 1 | 2:
                tokens = list(_TOKEN.finditer(lines[at]))
                if tokens:
                    token = rng.choice(tokens)
                    other = rng.choice(NASTY).encode()
                    lines[at] = lines[at][: token.start()] + other + lines[at][token.end() :]
            case 3:
                del lines[at]
            case 4:
                lines.insert(rng.randrange(len(lines)), lines[at])
            case 5:
                lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
            case 6:
                lines[at] = lines[at].replace(b",", rng.choice((b";", b"\t", b",,", b"")))
            case _:
                second = rng.randrange(len(lines))
                lines[at], lines[second] = lines[second], lines[at]
    text = b"\n".join(lines)
    return damaged_bytes(text, rng) if rng.random() < 0.2 else text
