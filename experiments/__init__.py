"""The papers' experiments, played and measured again."""
