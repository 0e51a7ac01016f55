"""The GPU's flight kernel as a library for this machine's processor: a look at its arithmetic without a GPU.

Numba-cuda turns the Python source into LLVM's language for NVIDIA's compiler. Here that text is taken as it is, linked
with NVIDIA's own mathematical functions (libdevice: sin, cos, exp, log, pow) and compiled for the CPU. With `fused`,
products and sums may be contracted, as NVIDIA's compiler does by default; it may choose other ones than LLVM does here.
Needs what maxq[gpu] installs, no GPU and no driver, and a C compiler to link.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import llvmlite.binding as llvm
from numba import from_dtype, types
from numba.cuda import compiler, dispatcher

from maxq.control.kernel.records import dtype_of
from maxq.sim.flight import on_gpu
from maxq.sim.flight.loop import Logged
from maxq.sim.flight.parameters import Memory, Parameters

ARCHITECTURE = (9, 0)  # sm_90: H100, H200

_INTRINSICS = {  # what libdevice calls in double precision, to nearest, in terms of what every processor has
    "d2i.hi": ("i32", "double %x", "%b = bitcast double %x to i64; %s = lshr i64 %b, 32; %r = trunc i64 %s to i32"),
    "d2i.lo": ("i32", "double %x", "%b = bitcast double %x to i64; %r = trunc i64 %b to i32"),
    "lohi.i2d": (
        "double",
        "i32 %l, i32 %h",
        "%a = zext i32 %l to i64; %b = zext i32 %h to i64; %c = shl i64 %b, 32; %d = or i64 %a, %c; "
        "%r = bitcast i64 %d to double",
    ),
    "d2i.rn": (
        "i32",
        "double %x",
        "%y = call double @llvm.rint.f64(double %x); %r = call i32 @llvm.fptosi.sat.i32.f64(double %y)",
    ),
    "d2ll.rn": (
        "i64",
        "double %x",
        "%y = call double @llvm.rint.f64(double %x); %r = call i64 @llvm.fptosi.sat.i64.f64(double %y)",
    ),
    "i2d.rn": ("double", "i32 %x", "%r = sitofp i32 %x to double"),
    "fma.rn.d": (
        "double",
        "double %x, double %y, double %z",
        "%r = call double @llvm.fma.f64(double %x, double %y, double %z)",
    ),
    "add.rn.d": ("double", "double %x, double %y", "%r = fadd double %x, %y"),
    "mul.rn.d": ("double", "double %x, double %y", "%r = fmul double %x, %y"),
    "div.rn.d": ("double", "double %x, double %y", "%r = fdiv double %x, %y"),
    "sqrt.rn.d": ("double", "double %x", "%r = call double @llvm.sqrt.f64(double %x)"),
    "rcp.rn.d": ("double", "double %x", "%r = fdiv double 1.0, %x"),
    "rcp.approx.ftz.d": (  # a first guess of 20 bits, which its caller improves
        "double",
        "double %x",
        "%q = fdiv double 1.0, %x; %b = bitcast double %q to i64; %m = and i64 %b, -4294967296; "
        "%r = bitcast i64 %m to double",
    ),
    "fmax.d": ("double", "double %x, double %y", "%r = call double @llvm.maxnum.f64(double %x, double %y)"),
    "fmin.d": ("double", "double %x, double %y", "%r = call double @llvm.minnum.f64(double %x, double %y)"),
    "fabs.f64": ("double", "double %x", "%r = call double @llvm.fabs.f64(double %x)"),
    "fabs.f32": ("float", "float %x", "%r = call float @llvm.fabs.f32(float %x)"),
    "trunc.d": ("double", "double %x", "%r = call double @llvm.trunc.f64(double %x)"),
    "floor.d": ("double", "double %x", "%r = call double @llvm.floor.f64(double %x)"),
}
_SURROUNDINGS = """
@block = global i32 0
@lane = global i32 0
define i32 @sreg.tid.x() {
  %r = load i32, ptr @lane
  ret i32 %r
}
define i32 @sreg.ctaid.x() {
  %r = load i32, ptr @block
  ret i32 %r
}
define i32 @sreg.ntid.x() {
  ret i32 32
}
define i32 @__nvvm_reflect(ptr %name) { ; __CUDA_FTZ: 0, __CUDA_PREC_SQRT: 1, __CUDA_ARCH: 900
  %at = getelementptr i8, ptr %name, i64 7
  %letter = load i8, ptr %at
  %is_f = icmp eq i8 %letter, 70
  %is_a = icmp eq i8 %letter, 65
  %known = select i1 %is_a, i32 900, i32 1
  %r = select i1 %is_f, i32 0, i32 %known
  ret i32 %r
}
declare void @abort()
define { i64, i64 } @huge_angle() { ; sin and cos of angles above 1e5 rad, which no flight has
  call void @abort()
  ret { i64, i64 } zeroinitializer
}
declare float @llvm.fabs.f32(float)
declare double @llvm.rint.f64(double)
declare double @llvm.fma.f64(double, double, double)
declare double @llvm.sqrt.f64(double)
declare double @llvm.fabs.f64(double)
declare double @llvm.trunc.f64(double)
declare double @llvm.floor.f64(double)
declare double @llvm.maxnum.f64(double, double)
declare double @llvm.minnum.f64(double, double)
declare i32 @llvm.fptosi.sat.i32.f64(double)
declare i64 @llvm.fptosi.sat.i64.f64(double)
"""


def device_code() -> tuple[str, list[str]]:
    """Name of the kernel, and the LLVM text of it and all that it calls, as NVIDIA's compiler gets it."""
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=ARCHITECTURE)  # there is none
    parameters, memory, logged = (from_dtype(dtype_of(schema)) for schema in (Parameters, Memory, Logged))
    number, whole = types.float64, types.int64
    signature = tuple(
        types.Array(dtype, dimensions, "C")
        for dtype, dimensions in (
            (parameters, 2), (number, 1), (memory, 1), (number, 3), (number, 3), (whole, 1), (whole, 1), (logged, 1),
            (whole, 1), (number, 2), (whole, 1),
        )
    )  # fmt: skip
    library, _ = compiler._compile_pyfunc_with_fixup(
        on_gpu._fly_on, signature, device=False, abi="numba", cc=ARCHITECTURE, debug=False, opt=True
    )
    return library._entry_name, list(library.llvm_strs)


def build(kernel: str, texts: list[str], libdevice: Path, out: Path, fused: bool) -> None:
    """Write a shared library with the kernel, and the globals `block` and `lane` that say which thread it is."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    llvm.initialize_native_asmparser()
    triple = llvm.get_process_triple()
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2, reloc="pic"
    )
    head = f'target triple = "{triple}"\ntarget datalayout = "{machine.target_data}"\n'
    parts = [llvm.parse_assembly(_here(head, _plain_pointers(text), fused)) for text in texts]
    parts.append(llvm.parse_assembly(_mathematics(head, libdevice)))
    parts.append(llvm.parse_assembly(head + _intrinsics() + _SURROUNDINGS))
    whole, *rest = parts
    for part in rest:
        whole.link_in(part)
    for function in whole.functions:
        if not function.is_declaration and function.name != kernel:
            function.linkage = "internal"
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(whole, builder)
    with_suffix = out.with_suffix(".o")
    with_suffix.write_bytes(machine.emit_object(whole))
    subprocess.run(["cc", "-shared", "-o", out, with_suffix, "-lm"], check=True)


def _here(head: str, text: str, fused: bool) -> str:
    """Text for another machine as text for this one."""
    text = re.sub(r"^target .*$", "", text, flags=re.MULTILINE).replace("llvm.nvvm.read.ptx.sreg.", "sreg.")
    if fused:
        text = re.sub(r"\bf(add|sub|mul) double", r"f\1 contract double", text)
    return head + text


def _mathematics(head: str, libdevice: Path) -> str:
    text = _here(head, str(llvm.parse_bitcode(libdevice.read_bytes())), fused=False)  # says itself what it fuses
    text = text.replace("@llvm.nvvm.", "@nvvm.")
    text = re.sub(r"call \{ i64, i64 \} asm .*$", "call { i64, i64 } @huge_angle()", text, flags=re.MULTILINE)
    text = re.sub(r"^attributes #(\d+) = .*$", r"attributes #\1 = { nounwind }", text, flags=re.MULTILINE)
    return "\n".join(line for line in text.splitlines() if not line.startswith("!nvvm")) + (
        "\ndeclare { i64, i64 } @huge_angle()\n"
    )


def _intrinsics() -> str:
    return "".join(
        f"define {result} @nvvm.{name}({arguments}) {{\n{body.replace('; ', chr(10))}\nret {result} %r\n}}\n"
        for name, (result, arguments, body) in _INTRINSICS.items()
    )


def _plain_pointers(text: str) -> str:
    """LLVM's old notation, in which every pointer says what it points to, in the new one, where it is `ptr`."""
    lines = (line for line in text.splitlines() if not line.startswith(("!nvvm", '@"llvm.used"')))
    names: list[str] = []

    def put_aside(found: re.Match[str]) -> str:
        names.append(found[0])
        return f"@@{len(names) - 1}@@"

    out: list[str] = []
    opened: list[int] = []
    begin = 0
    for piece in re.split(r"([\[\]{}()*])", re.sub(r'"[^"]*"', put_aside, "\n".join(lines))):
        if piece == "*":
            if out[-1] in ("]", "}", ")"):
                if out[-1] == ")":  # a function's type: what it returns stands before
                    out[begin - 1] = re.sub(r"\w+ $", "", out[begin - 1])
                del out[begin:]
            else:
                out[-1] = re.sub(r"(?:i\d+|double|float|ptr|void)$", "", out[-1])
            out.append("ptr")
        else:
            if piece in ("[", "{", "("):
                opened.append(len(out))
            elif piece in ("]", "}", ")"):
                begin = opened.pop()
            if piece:
                out.append(piece)
    return re.sub(r"@@(\d+)@@", lambda found: names[int(found[1])], "".join(out))
