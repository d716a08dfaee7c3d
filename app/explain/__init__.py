"""Stories: how a cluster or a tree came to be what it is, told when somebody asks."""
