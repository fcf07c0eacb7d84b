"""Our learned dispatch policy: network, training, inference and refinement."""
