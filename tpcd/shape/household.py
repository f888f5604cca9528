"""Household objects: what draws each of them, its dimensions, and who published those."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shapely.geometry import Polygon

from tpcd.shape import tools, vessels


@dataclass(frozen=True)
class Entry:
    """One household object: how it is drawn, how large it is, who says so."""

    maker: Callable[..., Polygon]
    """Draws the silhouette from the dimensions."""
    dimensions: dict[str, float]
    """Arguments of the maker [mm; `bend` in degrees]."""
    source: str
    """The standard or product the dimensions are taken from."""
    edge: float = 2.0
    """Radius of the edges [mm]."""


def _entry(
    maker: Callable[..., Polygon], source: str, edge: float | int = 2, **sizes: float | int
) -> Entry:
    dimensions = {key: float(size) for key, size in sizes.items()}
    return Entry(maker=maker, dimensions=dimensions, source=source, edge=float(edge))


_PRODUCT = "typical retail product"

ENTRIES: dict[str, Entry] = {
    "soup_can": _entry(vessels.box, "US can size 211 x 400", width=68.3, height=101.6),
    "tuna_can": _entry(vessels.box, "US can size 307 x 113", width=87.3, height=46.0),
    "coffee_can": _entry(vessels.box, "US can size 401 x 411", width=103.2, height=119.1),
    "drink_can": _entry(
        vessels.capped_bottle,
        "330 ml beverage can: body 211, end 202, height 115 mm",
        body=66.2,
        body_height=95,
        shoulder=14,
        neck=54,
        neck_height=3,
        cap=56,
        cap_height=3,
    ),
    "wine_bottle": _entry(
        vessels.bottle,
        "0.75 l Bordeaux bottle, EN 12726 mouth",
        body=76,
        body_height=190,
        shoulder=35,
        neck=30,
        neck_height=75,
    ),
    "beer_bottle": _entry(
        vessels.capped_bottle,
        "0.33 l longneck bottle, crown cork DIN 6099",
        body=61,
        body_height=130,
        shoulder=55,
        neck=27,
        neck_height=37,
        cap=32,
        cap_height=6,
    ),
    "water_bottle": _entry(
        vessels.capped_bottle,
        "0.5 l PET bottle, neck finish PCO 1881",
        body=65,
        body_height=140,
        shoulder=45,
        neck=26,
        neck_height=8,
        cap=31,
        cap_height=16,
    ),
    "jam_jar": _entry(
        vessels.capped_bottle,
        "370 ml jar, twist-off lid TO 66",
        body=74,
        body_height=90,
        shoulder=9,
        neck=62,
        neck_height=3,
        cap=69,
        cap_height=12,
    ),
    "spray_bottle": _entry(
        vessels.spray_bottle,
        "0.75 l cleaner, trigger neck 28/400",
        body=92,
        body_height=150,
        shoulder=55,
        neck=30,
        neck_height=15,
        head=44,
        head_height=32,
        nozzle=40,
        trigger=38,
    ),
    "cereal_box": _entry(vessels.box, _PRODUCT + ", 375 g", width=190, height=280),
    "juice_carton": _entry(vessels.box, "1 l slim brick carton", width=90, height=195),
    "milk_carton": _entry(
        vessels.gable_carton,
        "1 l gable-top carton, base 70 x 70 mm",
        width=70,
        height=195,
        gable=32,
        fin=16,
    ),
    "book": _entry(vessels.box, "ISO 216 A5, hard cover 30 mm", width=30, height=210),
    "bank_card": _entry(
        vessels.card, "ISO/IEC 7810 ID-1", edge=1, width=85.6, height=53.98, corner=3.18
    ),
    "phone": _entry(vessels.card, "6.1 inch telephone", width=71.5, height=146.7, corner=11),
    "remote_control": _entry(vessels.card, _PRODUCT, width=46, height=178, corner=14),
    "brick": _entry(vessels.box, "DIN 105 normal format", edge=3, width=240, height=71),
    "cube_puzzle": _entry(vessels.box, "3 x 3 x 3 cube puzzle", width=57, height=57),
    "hex_nut": _entry(vessels.regular, "ISO 4032 M36", edge=1, across_flats=55),
    "battery": _entry(
        vessels.capped_bottle,
        "IEC 60086-2 R20 (D)",
        edge=1,
        body=34.2,
        body_height=59.0,
        shoulder=0.5,
        neck=33,
        neck_height=0.5,
        cap=9.5,
        cap_height=1.5,
    ),
    "tennis_ball": _entry(vessels.ball, "ITF rules: 65.4 to 68.6 mm", diameter=67),
    "golf_ball": _entry(vessels.ball, "R&A rules: 42.67 mm", diameter=42.67),
    "soap_bar": _entry(vessels.ellipse, _PRODUCT + ", 100 g", width=90, height=58),
    "egg": _entry(vessels.egg, "EU size L", width=45, height=59, blunt=25),
    "apple": _entry(vessels.apple, "EU class I, 75 mm", width=78, height=71, dimple=9),
    "pear": _entry(vessels.pear, "EU class I, 65 mm", width=68, height=108, crown=30),
    "banana": _entry(
        vessels.bent_fruit, "EU grade, 200 mm", length=200, thickness=36, bend=80, tip=9
    ),
    "paper_cup": _entry(vessels.tapered, "12 oz paper cup", bottom=60, top=90, height=110),
    "mug": _entry(
        vessels.mug, "11 oz mug", diameter=82, height=95, handle_reach=33, handle_height=68
    ),
    "bowl": _entry(vessels.bowl, _PRODUCT, rim=155, foot=70, height=62, foot_height=6),
    "wine_glass": _entry(
        vessels.wine_glass,
        "ISO 3591 style tasting glass, scaled to 400 ml",
        foot=72,
        stem=8,
        stem_height=85,
        bowl=82,
        bowl_height=110,
    ),
    "light_bulb": _entry(
        vessels.light_bulb, "IEC A60 with E27 base", globe=60, height=106, base=26.5, base_height=27
    ),
    "toothpaste": _entry(
        vessels.squeeze_tube, "75 ml tube", crimp=56, shoulder=38, length=130, cap=30, cap_height=25
    ),
    "screwdriver": _entry(
        tools.screwdriver,
        "ISO 2380 blade 1.2 x 6.5 x 150",
        handle=34,
        handle_length=110,
        shaft=6.5,
        shaft_length=150,
    ),
    "hammer": _entry(
        tools.hammer,
        "DIN 1041 500 g",
        length=320,
        handle=26,
        head_length=118,
        head_height=36,
        face=27,
    ),
    "wrench": _entry(
        tools.wrench,
        "DIN 3113 A combination spanner 24 mm",
        length=260,
        shank=20,
        head=52,
        ring=37,
        jaw=24,
    ),
    "spoon": _entry(
        tools.spoon,
        "table spoon, 200 mm",
        edge=1,
        length=200,
        bowl_length=68,
        bowl_width=44,
        neck=8,
        end=20,
    ),
    "kitchen_knife": _entry(
        tools.knife,
        _PRODUCT + ", 200 mm blade",
        edge=1,
        length=330,
        blade=45,
        blade_length=205,
        handle=28,
    ),
    "c_clamp": _entry(
        tools.c_clamp,
        "100 mm C-clamp",
        opening=100,
        throat=60,
        bar=20,
        screw=13,
        screw_length=150,
    ),
    "toothbrush": _entry(
        tools.toothbrush,
        "adult toothbrush, 190 mm",
        edge=1,
        length=190,
        handle=14,
        neck=5.5,
        head=12,
        head_length=28,
    ),
    "saucepan": _entry(
        tools.saucepan, "160 mm saucepan", diameter=160, height=80, handle_length=160, handle=20
    ),
    "cordless_drill": _entry(
        tools.drill,
        "18 V drill driver",
        body_length=140,
        body=62,
        chuck=44,
        chuck_length=45,
        grip=42,
        grip_length=90,
        battery=115,
        battery_height=45,
    ),
    "dumbbell": _entry(
        tools.dumbbell, "2 kg hexagonal dumbbell", length=180, head=72, head_length=55, grip=28
    ),
    "shelf_bracket": _entry(tools.bracket, _PRODUCT, width=125, height=150, thickness=20),
    "pliers": _entry(
        tools.pliers,
        "ISO 5746 combination pliers 180 mm",
        length=180,
        jaw_length=45,
        width=26,
        arm=13,
        spread=50,
    ),
    "scissors": _entry(
        tools.scissors,
        "200 mm household scissors",
        length=205,
        blade_length=110,
        blade=26,
        loop=40,
        loop_height=70,
    ),
    "padlock": _entry(
        tools.padlock, "50 mm padlock", width=50, height=42, shackle=38, shackle_height=38
    ),
    "stapler": _entry(tools.stapler, "24/6 desk stapler", length=140, base=14, gap=18, arm=32),
}
"""All built-in objects by name."""
