"""The layout of ``interchange.sionna_cir`` beside Sionna RT's own ``Paths.cir``, on the same links.

    .venv/bin/python benchmarks/peers/cir_layout.py write OUT.npz
    benchmarks/peers/.venv/bin/python benchmarks/peers/cir_layout.py compare OUT.npz

Free space, two transmitters of 1 x 2 and three receivers of 2 x 1 elements, half a wavelength apart:
nothing but the layout and the conventions can differ. Prints the shapes, the largest difference of a
(relative) and of tau.
"""

import sys

import numpy as np

FREQUENCY = 3.5e9
TX = ((0.0, 0.0, 1.5), (10.0, -4.0, 3.0))
RX = ((5.0, 3.0, 1.0), (-2.0, 8.0, 2.0), (20.0, 1.0, 1.5))


def write(file: str) -> None:
    import rfsg
    from rfsg.interchange import write_sionna

    # in the order of Sionna's PlanarArray, whose rows run from the top down (rfsg's: bottom up)
    wide = rfsg.Array.of([[0.0, -0.25, 0.0], [0.0, 0.25, 0.0]])
    tall = rfsg.Array.of([[0.0, 0.0, 0.25], [0.0, 0.0, -0.25]])
    options = {"polarization": "V"}
    scene = rfsg.Scene(
        transmitters=tuple(
            rfsg.Radio.at(f"/tx{i}", *p, array=wide, **options) for i, p in enumerate(TX)
        ),
        receivers=tuple(
            rfsg.Radio.at(f"/rx{i}", *p, array=tall, **options) for i, p in enumerate(RX)
        ),
    )
    write_sionna(rfsg.simulate(scene, FREQUENCY), file)


def compare(file: str) -> None:
    import sionna.rt as rt

    scene = rt.load_scene()
    scene.frequency = FREQUENCY
    common = dict(vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V")
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=2, **common)
    scene.rx_array = rt.PlanarArray(num_rows=2, num_cols=1, **common)
    for i, place in enumerate(TX):
        scene.add(rt.Transmitter(f"tx{i}", position=place))
    for i, place in enumerate(RX):
        scene.add(rt.Receiver(f"rx{i}", position=place))
    a, tau = rt.PathSolver()(scene, max_depth=0).cir(out_type="numpy")
    with np.load(file) as ours:
        mine, delay = ours["a"][0], ours["tau"][0]
    print("a  ", a.shape, mine.shape)
    print("tau", tau.shape, delay.shape)
    print("largest difference of a, of its largest:", np.abs(a - mine).max() / np.abs(a).max())
    print("largest difference of tau [s]:", np.abs(tau - delay).max())


if __name__ == "__main__":
    {"write": write, "compare": compare}[sys.argv[1]](sys.argv[2])
