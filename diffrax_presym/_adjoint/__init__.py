from ._reversible import ReversibleAdjoint as ReversibleAdjoint
