"""Search the DataID lists of the protected messages; ``python -m dbc.dataid_search`` prints them.

The CRC of profile 2 finds every 1-, 2- and 3-bit error as long as the DataID is fixed. An error in the
counter, however, also exchanges the DataID, and with a careless list the two can cancel: a pattern that turns
counter c into c' slips through exactly if the CRC contribution of ``ids[c] ^ ids[c']`` equals the pattern's
own. The CRC is linear, so the payload's content does not matter. The search collects, per change of the
counter, the DataID differences that would hide some pattern of at most three bits, and fills the list by
backtracking, avoiding them.
"""

import random
from collections.abc import Iterator
from itertools import combinations

from dbc.contract import Contract
from dbc.e2e import profile2_crc

MAX_BIT_ERRORS = 3
COUNTER_BITS = range(8, 12)


def bit_contributions(dlc: int) -> list[int]:
    """Return, per payload bit, how flipping it changes received XOR computed CRC, the DataID being fixed."""
    neutral = profile2_crc(0, dlc, 0)
    return [1 << bit if bit < 8 else profile2_crc(1 << bit, dlc, 0) ^ neutral for bit in range(8 * dlc)]


def hidden_differences(dlc: int) -> list[set[int]]:
    """Return, per XOR difference of the counter, the DataID XOR differences that would hide an error.

    Index 0 is empty: an error that leaves the counter alone leaves the DataID alone, and the CRC finds it.
    """
    neutral = profile2_crc(0, dlc, 0)
    difference_of = {profile2_crc(0, dlc, difference) ^ neutral: difference for difference in range(256)}
    contributions = bit_contributions(dlc)
    hidden: list[set[int]] = [set() for _ in range(16)]
    for number in range(1, MAX_BIT_ERRORS + 1):
        for bits in combinations(range(8 * dlc), number):
            counter_change = sum(1 << bit - 8 for bit in bits if bit in COUNTER_BITS)
            if counter_change:
                syndrome = 0
                for bit in bits:
                    syndrome ^= contributions[bit]
                hidden[counter_change].add(difference_of[syndrome])
    return hidden


def find_data_ids(dlc: int, taken: set[int], rng: random.Random) -> tuple[int, ...]:
    """Return 16 DataIDs for a message of `dlc` bytes that hide no error of at most three bits.

    Only ids of even weight are tried: the generator polynomial has the factor x + 1, so that among them every
    error of odd weight is found. None of `taken` is used, so that no message can pass for another.
    """
    hidden = hidden_differences(dlc)
    candidates = [i for i in range(1, 256) if i.bit_count() % 2 == 0 and i not in taken]
    rng.shuffle(candidates)
    complete = next(_extend((), candidates, hidden), None)
    if complete is None:
        raise ValueError(f"no DataID list for {dlc} bytes avoids the {len(taken)} ids taken")
    return complete


def _extend(ids: tuple[int, ...], candidates: list[int], hidden: list[set[int]]) -> Iterator[tuple[int, ...]]:
    counter = len(ids)
    if counter == len(hidden):
        yield ids
        return
    for candidate in candidates:
        if candidate not in ids and all(
            candidate ^ other not in hidden[counter ^ index] for index, other in enumerate(ids)
        ):
            yield from _extend((*ids, candidate), candidates, hidden)


def main() -> None:
    """Print one list per protected message of the packaged contract, in order of priority."""
    rng = random.Random(2)
    taken: set[int] = set()
    for message in Contract.load().messages:
        if message.data_ids is not None:
            data_ids = find_data_ids(message.dlc, taken, rng)
            taken.update(data_ids)
            print(f"{message.name} {','.join(map(str, data_ids))}")


if __name__ == "__main__":
    main()
