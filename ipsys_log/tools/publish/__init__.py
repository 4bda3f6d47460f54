"""Packs: datasets with checksums and expected scores, and their re-scoring."""
