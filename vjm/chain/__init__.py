"""Virtual links and joints: the chain as data, its layouts, and the curve that it stands for."""
