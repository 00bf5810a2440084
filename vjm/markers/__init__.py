"""From markers to joint angles, rates and accelerations: eqs. (1)-(12)."""
