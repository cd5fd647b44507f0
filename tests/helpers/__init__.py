"""Scenes, images, grids and files that several test modules share."""
