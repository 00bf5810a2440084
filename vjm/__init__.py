"""Virtual joint models of flexible robot arms, identified from camera markers."""
