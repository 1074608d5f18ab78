"""Preface: a volumetric prior for faces, from raw photographs to a head rendered from any side."""
