"""The plant `detailed`: machines with exciters, stabilisers and governors on the full AC network."""
