"""Meshes of simplices: built, checked and measured."""
