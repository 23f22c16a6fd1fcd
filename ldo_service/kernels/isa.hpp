// Selection of the instruction set: the widest that this machine has, or the one that LDO_ISA
// names.
#pragma once
#include <cstdlib>
#include <stdexcept>
#include <string>

namespace ldo {

enum class Isa { baseline, avx2, avx512 };

inline const char* name(Isa isa) {
  switch (isa) {
    case Isa::avx512:
      return "avx512";
    case Isa::avx2:
      return "avx2";
    default:
      return "baseline";
  }
}

inline bool has(Isa isa) {
#if LDO_X86
  __builtin_cpu_init();
  if (isa == Isa::avx512)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  if (isa == Isa::avx2) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
  return isa == Isa::baseline;
}

// Return the instruction set to use; called once, when a module is imported. Throw
// std::runtime_error if LDO_ISA names a set that is unknown or that this machine lacks: a run that
// requests one set must not silently use another.
inline Isa chosen_isa() {
  const char* forced = std::getenv("LDO_ISA");
  const bool any = forced == nullptr || *forced == '\0';
  for (Isa isa : {Isa::avx512, Isa::avx2, Isa::baseline}) {
    if (any && has(isa)) return isa;
    if (!any && std::string(forced) == name(isa)) {
      if (has(isa)) return isa;
      throw std::runtime_error(std::string("LDO_ISA=") + forced +
                               ": this machine has no such instructions; unset it or use baseline");
    }
  }
  throw std::runtime_error(std::string("LDO_ISA=") + forced +
                           ": must be avx512, avx2 or baseline, or unset");
}

}  // namespace ldo
