"""The weights of the compositions: of schemes, and of flows within a move.

All are symmetric, so only the first half is listed, including the middle. All known
digits are kept, more than a float holds.
"""

from collections.abc import Callable, Sequence

import jax
import jax.lax as lax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ._numbers import cast_to


def mirror(*half: float) -> tuple[float, ...]:
    """A palindrome of odd length from its first half, including the middle."""
    return (*half, *half[-2::-1])


# M. Suzuki (1990), Physics Letters A 146, 319: w = 1 / (4 - 4^(1/3)).
SUZUKI_4 = mirror(
    0.414490771794375737142354062860761495711774604,
    0.414490771794375737142354062860761495711774604,
    -0.657963087177502948569416251443045982847098416,
)

# M. Sofroniou and G. Spaletta (2005), Optim. Methods Softw. 20, 597, by order.
SOFRONIOU_SPALETTA = {
    6: mirror(
        0.138619308540516952458080130426253537644818248,
        0.133465628510747604070468588322092559649753689,
        0.130705310114492251905427557850152043401431775,
        0.12961893756907034772505366537091184176909887,
        -0.350003248939208965161708309113225605668840428,
        0.118055306530023871702734389540489755365728649,
        0.399077515348715874599887955206651735676018395,
    ),
    8: mirror(
        0.106477289845500318239319678548958514957780294,
        0.108374086458357263974334105915459220955800994,
        0.353378210526543424195345413240799339843809432,
        -0.233414140231650821987802811283194796110512119,
        -0.244452667915288412694621714132164173141830965,
        0.113178484357556333147009525155989751045177355,
        0.118929056250003500626929722839508473692534794,
        0.12603912321825988140305670268364623322235073,
        0.125817187361760418043923916415866222034346962,
        0.116991350192176421807228814335329066991943872,
        -0.382635960126436653509446707440395706982802697,
    ),
    10: mirror(
        0.0787957225216864192639076793376842482198638728,
        0.313096103415108527764812471926472696881054022,
        0.0279183832350780661095202732752988231186749257,
        -0.229592841593907094151213396796549875909924547,
        0.130962061077164863174656859279605412674738502,
        -0.269733405654510714344609732224111497115542052,
        0.0749733431558914356661371056414104123434139257,
        0.111993423999810204889575080736402058720887098,
        0.366133449546226751193148123531499082375253646,
        -0.399105630136035897878629810583404730395862388,
        0.103087398527471077315802770013724479179869986,
        0.411430873955890237820704118976078350507172768,
        -0.004866360583135261762195659309977063020407692,
        -0.392033353708639906448081936426104269693819342,
        0.0519425029624496470371829040159757277497133837,
        0.0506650907599244963358743441568658941954362274,
        0.0496743706397298790545688002794611763445541576,
        0.0493177357595945379176800083393381476498470148,
    ),
}


def substeps(weights: Sequence[float]) -> np.ndarray:
    """Start, end and length of consecutive stages, in units of the whole."""
    ends = np.cumsum(weights)
    ends[-1] = 1
    starts = np.concatenate([[0], ends[:-1]])
    return np.stack([starts, ends, weights], axis=-1)


def lengths(order: int, h: ArrayLike) -> Array:
    """The lengths of the stages of a composition of symmetric maps of order two, of at
    least the given order, or the highest known."""
    known = {2: (1.0,), 4: SUZUKI_4} | SOFRONIOU_SPALETTA
    weights = next((x for r, x in known.items() if r >= order), known[10])
    return cast_to(np.array(weights), h) * h


def over_stages(stage: Callable, state: PyTree, rows: PyTree) -> PyTree:
    """The state after `stage(state, row)` for each row of arrays."""
    if len(jtu.tree_leaves(rows)[0]) == 1:
        # The derivative of a loop of one iteration copies all that it keeps, one by
        # one: that may be a fifth of the code of a gradient.
        return stage(state, jtu.tree_map(lambda x: x[0], rows))
    # A gradient computes each again: to keep all that they consist of may take twice as
    # long to compile.
    stage = jax.checkpoint(stage, prevent_cse=False)
    return lax.scan(lambda *x: (stage(*x), None), state, rows)[0]
