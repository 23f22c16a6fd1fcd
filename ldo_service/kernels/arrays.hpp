// Argument checks that all bindings share, with the same error messages.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <string>

namespace ldo {

namespace nb = nanobind;

using Array = nb::ndarray<nb::ro>;
using WritableArray = nb::ndarray<>;

inline void require(bool condition, const std::string& message) {
  if (!condition) throw nb::value_error(message.c_str());
}

template <class T>
const char* type_name() {
  if constexpr (std::is_same_v<T, float>) return "float32";
  if constexpr (std::is_same_v<T, double>) return "float64";
  if constexpr (std::is_same_v<T, uint8_t>) return "uint8";
  if constexpr (std::is_same_v<T, int16_t>) return "int16";
  if constexpr (std::is_same_v<T, int32_t>) return "int32";
  if constexpr (std::is_same_v<T, int64_t>) return "int64";
  if constexpr (std::is_same_v<T, uint32_t>) return "uint32";
}

// Return the values of an array of type T. It must be contiguous, with the last axis fastest.
template <class T, class AnyArray>
auto* values_of(const AnyArray& array, const std::string& name) {
  require(array.dtype() == nb::dtype<T>() && array.device_type() == nb::device::cpu::value,
          name + " must be " + type_name<T>() + " in main memory.");
  int64_t stride = 1;
  for (size_t axis = array.ndim(); axis-- > 0; stride *= array.shape(axis))
    require(array.size() == 0 || array.shape(axis) < 2 || array.stride(axis) == stride,
            name + " must be contiguous, last axis fastest: use np.ascontiguousarray.");
  if constexpr (std::is_same_v<AnyArray, Array>)
    return static_cast<const T*>(array.data());
  else
    return static_cast<T*>(array.data());
}

template <class AnyArray>
void require_shape(const AnyArray& array, const std::string& name,
                   std::initializer_list<size_t> shape) {
  bool equal = array.ndim() == shape.size();
  std::string wanted;
  size_t axis = 0;
  for (size_t size : shape) {
    equal = equal && array.shape(axis++) == size;
    wanted += (wanted.empty() ? "" : ", ") + std::to_string(size);
  }
  require(equal, name + " must have shape [" + wanted + "].");
}

inline void require_threads(int threads) {
  require(threads >= 1, "threads must be at least 1, got " + std::to_string(threads) + ".");
}

}  // namespace ldo
