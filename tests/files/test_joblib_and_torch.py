"""Pickles of joblib and PyTorch, as those libraries wrote them, and such as would run code."""

from __future__ import annotations

import base64
import bz2
import gzip
import io
import lzma
import os
import pickle
import struct
import sys
import types
import zlib

import numpy as np
import pytest

from xavatar_jax.files import UnsafePickleError, load_pickle

# Written by joblib 1.6.0 with NumPy 2.4.6 (protocols 2 and 5) and by joblib with PyTorch 2.13.0;
# compressed and encoded to stand here.
JOBLIB = {
    2: (
        r"c-m!B$!^p@5N+EylQ@Bd0AUIH>aZAyIOKpdL6Jbh(nOjIz97r?bZCRO@}e+OEDeVwGm>vKCoX&@x6m$o5&|uE+pg+*ui"
        r"on($t4iok_aIlNZ#kz4Sd&#iZB`4iSK<0sMf20-lVBB{E#|HLQ@UowQr!5a7MRgMPXLBUf^UIs2&z-(ZH#<YcOM}b)Gp"
        r"1g^nqk$^pz`C{717g*oKi0u5t>d?>cfw;1@R!Ga}=)Xpn7I~gCsxjroFrh;X!VX4>ay+0BI7n9_0-nBH5a)Kb<wZqU!V"
        r"0mn<ibx{}yRx0Y{}hEZ%58U;(+n<{ONHAxY6ihE>WXDkJYtT-{I!XcJ8+TJ(l3>;qBE7vuvXM%)<}5^SJ*sTWXofQs8W"
        r"lEINb(|oZv-pwS;T<>BA~QUoYXtG4wv%WOGatkc|!gI^3#lxZQ_4!Up!g0e9VFZWZ+?L?Rh7#BdK8?w9c3FNTMw7`8Xy"
        r"QO%(DVQp&k9y~tH)6L<D;F&Z$BlXA6MkT3M&}YN;;*=U;5#&Bv&Z`AGrCuCmd0Kcm|IRBFck-&!-W3ru$v)qbTz<&=Ts"
        r"I}r9A`?U;zg)S<n0YEdc&+zNqhX?uDCn-$n}y}(pUbj`@88W>rs&~Pzi;nXu-1*jHv~rKELO!2`48vy$@KI!wY=x!b?*"
        r"=fc3)o17(~EF8"
    ),
    5: (
        r"c-n<h%SyvQ6wNdirD|1tf<I6ZvJe+8genCEBN5!Vl8~gM6U~b}(1Jo;R9l#xH!C-OmtW$p-pthaDCi|K%rN(!bI-ZyR`"
        r"WMS#yvDRaeyygg|_F~T9Els$BbO(+M~c1jN-Z<$5!VowxWo}@C+LdP*hDNneBL1k^rxYD&Uhr+bVJ~iB}V5MHKXku0G-"
        r"|jN4euNej>Iw1Y2f>hpxzm5Xf{^q=4q8oJ8KE*OS!G{g{_uB2e|n&o-njp_SV1bx0PI~9DU<++!EPlMF7J1I>-pU>>tu"
        r"nZ}++r(`TKU`g0uY39C$OTR=fK5nYY?9U3wCtPBa&iD{jxDj(K3gkb)e=wOG$ocI@lHy-0HHW>$54BS$?Ax>z$@<7mu9"
        r"v+uDIl!8~zMcAxeHc;z~FP|D-wD`EKpqFKe5EXdsEY)%@jC!iq3hGo3J|nxA>8D`(4R%$Pc1kfd?uq+-<L<JXlQw1^Fo"
        r"mWYPb@ALk@slhok3J-7Lu=zfcYEXR8@{Q7F`dhgo$0oFY4Xysuzr0=oq{wiCf9WG++6Q^CFU9"
    ),
}
TORCH = (
    r"c-rmMO>fgM7zgkqPFs{wnBc^1$MjNl(1z~BG|(>QbzE{mR+^Y4$ct;o*;J%TxpZPEH_VL#N4@|bijRPV1W(&^FR%jFN{"
    r"iw|asF}apKKTQ$FB`zc8s-K){bJ%s4lN7F2lG@a+R=5m$!(dgFImoQ8dlCB!_qP2Z%T4u?%j(K76)L7!M-yTJi%j7%7@"
    r"TYUj3T7=`uTVLv|Ye&2ZW<@ud<VLkbV;5rtD>#xJVhmtEEaz+lR%o3go69Rq{-mpX|MhQ)$BuItz&Uc_vjfRwD$y=HUG"
    r"#0k&*Pt?sxm2QtEg!*Ck}6Thwr@|{;OV|-U^~y@pRPY0Z`EaCgtH+yyU=m<a$e~O)4u_kt*+PY+`qT!^*a46Pt4m5hq*"
    r"ww{!|J31+?}`7?)+upj|i4AH@T>Y{Lnqfbw};PxPL~2DUId))-;)Sf7+@V8CdofB@Lnp2>(x8a+xv1(K~jt>Bxou5y{u"
    r"NXNDtH?Da9&Wo@Gyyg`7B)+*IM3Ns}`Tg4uVKf1~$$7ixY>yymelP%yO3_&b#m5j?g4p)}r+)#_T83C<0nw`XsvXq0R^"
    r"3n6_8)j?L>FYnDv<4P&X$t(I=%m#cUAWHd1qd>37%oqvoK(RoO?a|xzek&?{&MI7q!ggTC*%@nWt16iyf`iIupv<zW^6"
    r"dAhG"
)
COMPRESSIONS = {
    "none": bytes,
    "zlib": lambda data: zlib.compress(data, 3),
    "fast zlib": lambda data: zlib.compress(data, 1),
    "gzip": gzip.compress,
    "bz2": bz2.compress,
    "lzma": lambda data: lzma.compress(data, lzma.FORMAT_ALONE),
    "xz": lzma.compress,
}


def decoded(text: str) -> bytes:
    return zlib.decompress(base64.b85decode(text))


@pytest.mark.parametrize("protocol", JOBLIB)
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_joblib_files_are_read(tmp_path, protocol, compression):
    path = tmp_path / "a.pkl"
    path.write_bytes(COMPRESSIONS[compression](decoded(JOBLIB[protocol])))
    found = load_pickle(path)
    expected = np.arange(6, dtype=np.float32).reshape(2, 3)
    for name in "cf":
        assert type(found[name]) is np.ndarray
        np.testing.assert_array_equal(found[name], expected, strict=True)
    np.testing.assert_array_equal(found["n"]["i"], np.array([3, 1], np.int16), strict=True)
    assert list(found["o"]) == [{"x": 1.5}, None]
    assert found["e"].shape == (0, 3)
    assert found["t"] == ("w", 2)


def test_torch_tensors_are_read_as_arrays(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(decoded(TORCH))
    found = load_pickle(path)
    whole = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.testing.assert_array_equal(found["whole"], whole, strict=True)
    np.testing.assert_array_equal(found["turned"], whole.T, strict=True)
    np.testing.assert_array_equal(found["row"], whole[1], strict=True)
    np.testing.assert_array_equal(found["whole_numbers"], np.array([7, 8]), strict=True)
    np.testing.assert_array_equal(found["yes"], whole > 4, strict=True)
    assert found["scalar"].shape == ()
    assert found["scalar"] == 2.5


class Call:
    """Pickled as a call, of a function or of a name."""

    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


def named(monkeypatch, module, name):
    """A stand-in that pickles under a name of a library that is not here."""
    parent = ""
    for part in module.split("."):
        parent = f"{parent}.{part}".lstrip(".")
        if parent not in sys.modules:
            monkeypatch.setitem(sys.modules, parent, types.ModuleType(parent))
    stand_in = type(name, (), {"__module__": module, "__qualname__": name})
    monkeypatch.setattr(sys.modules[module], name, stand_in, raising=False)
    return stand_in


def wrapped(monkeypatch, dtype, shape=(1,), **more):
    record = named(monkeypatch, "joblib.numpy_pickle", "NumpyArrayWrapper")()
    state = {"subclass": np.ndarray, "shape": shape, "order": "C", "dtype": dtype}
    record.__dict__.update(state, allow_mmap=False, **more)
    return record


def write(path, value, after=b""):
    """A pickle whose last object is followed by bytes in its stream: `after`, then its end."""
    path.write_bytes(pickle.dumps(value, 2)[:-1] + after + b".")
    return path


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_code_in_a_compressed_file_is_refused(tmp_path, compression):
    data = pickle.dumps({"smplx_params": [Call(os.system, f"touch {tmp_path}/ran")]})
    (tmp_path / "evil.pkl").write_bytes(COMPRESSIONS[compression](data))
    with pytest.raises(UnsafePickleError, match=r"evil\.pkl.*system"):
        load_pickle(tmp_path / "evil.pkl")
    assert not (tmp_path / "ran").exists()


def test_code_in_an_object_array_of_joblib_is_refused(tmp_path, monkeypatch):
    inner = np.array([Call(os.system, f"touch {tmp_path}/ran")], dtype=object)
    record = wrapped(monkeypatch, np.dtype(object))
    path = write(tmp_path / "evil.pkl", record, pickle.dumps(inner, 2))
    with pytest.raises(UnsafePickleError, match=r"evil\.pkl.*system"):
        load_pickle(path)
    assert not (tmp_path / "ran").exists()


def test_a_type_that_hides_its_objects_is_read_as_what_its_name_says(tmp_path, monkeypatch):
    lying = np.dtype(object).__reduce__()
    state = (*lying[2][:-1], 0)  # flags that deny the objects

    class Lie:
        def __reduce__(self):
            return (*lying[:2], state)

    record = wrapped(monkeypatch, Lie(), shape=(2,))
    path = write(tmp_path / "evil.pkl", record, struct.pack("<QQ", 1234, 5678))
    with pytest.raises(ValueError, match=r"evil\.pkl"):
        load_pickle(path)


@pytest.mark.parametrize("shape", [(3,), (-1,), (10**12,), (10**10, 10**10)])
def test_arrays_longer_than_the_file_are_refused(tmp_path, monkeypatch, shape):
    record = wrapped(monkeypatch, np.dtype("<f8"), shape=shape)
    path = write(tmp_path / "odd.pkl", record, np.arange(2.0).tobytes())
    with pytest.raises(ValueError, match=r"odd\.pkl"):
        load_pickle(path)


def storage(monkeypatch, count=4, kind=None):
    kind = named(monkeypatch, "torch", "FloatStorage") if kind is None else kind

    marker = object()

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            return ("storage", kind, "1", "cpu", count, None) if obj is marker else None

    stream = io.BytesIO()
    machine = {"little_endian": True}
    for value in (0x1950A86A20F9469CFC6C, 1001, machine, marker, ["1"]):
        Pickler(stream, 2).dump(value)
    stream.write(struct.pack("<q", count) + np.arange(4, dtype="<f4").tobytes())
    return stream.getvalue()


def tensor(monkeypatch, data, *view):
    rebuild = named(monkeypatch, "torch._utils", "_rebuild_tensor_v2")
    load = named(monkeypatch, "torch.storage", "_load_from_bytes")
    return Call(rebuild, Call(load, data), *view, False, {})


def test_a_tensor_is_a_view_of_its_storage(tmp_path, monkeypatch):
    path = write(tmp_path / "a.pkl", tensor(monkeypatch, storage(monkeypatch), 1, (2, 2), (1, 1)))
    np.testing.assert_array_equal(load_pickle(path), [[1, 2], [2, 3]])


@pytest.mark.parametrize(
    "view", [(0, (5,), (1,)), (3, (2,), (1,)), (-1, (1,), (1,)), (0, (2, 2), (4, 1)), (0, (2,), ())]
)
def test_a_tensor_that_reaches_outside_its_storage_is_refused(tmp_path, monkeypatch, view):
    path = write(tmp_path / "odd.pkl", tensor(monkeypatch, storage(monkeypatch), *view))
    with pytest.raises(ValueError, match=r"odd\.pkl"):
        load_pickle(path)


def test_code_inside_a_storage_is_refused(tmp_path, monkeypatch):
    evil = Call(os.system, f"touch {tmp_path}/ran")
    data = storage(monkeypatch, kind=evil)
    path = write(tmp_path / "evil.pkl", tensor(monkeypatch, data, 0, (4,), (1,)))
    with pytest.raises(UnsafePickleError, match=r"evil\.pkl.*system"):
        load_pickle(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["BFloat16Storage", "load", "Tensor"])
def test_other_names_of_torch_are_refused(tmp_path, monkeypatch, name):
    data = storage(monkeypatch, kind=named(monkeypatch, "torch", name))
    path = write(tmp_path / "a.pkl", tensor(monkeypatch, data, 0, (4,), (1,)))
    with pytest.raises(UnsafePickleError, match=rf"torch\.{name}"):
        load_pickle(path)


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("text", [JOBLIB[2], JOBLIB[5], TORCH], ids=["two", "five", "torch"])
def test_truncated_files_are_errors_of_ours(tmp_path, compression, text):
    data = COMPRESSIONS[compression](decoded(text))
    path = tmp_path / "cut.pkl"
    for length in range(0, len(data), 37):
        path.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"cut\.pkl"):
            load_pickle(path)


@pytest.mark.parametrize(("head", "name"), [(b'\x04"M\x18', "lz4"), (b"ZF0x10 ", "older")])
def test_compressions_that_are_not_read_are_named(tmp_path, head, name):
    (tmp_path / "a.pkl").write_bytes(head + bytes(40))
    with pytest.raises(ValueError, match=rf"a\.pkl.*{name}.*compress=.zlib"):
        load_pickle(tmp_path / "a.pkl")
