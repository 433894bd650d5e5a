"""The assigner: its network, its cases, its training, its export; and the paper's network and loss."""
