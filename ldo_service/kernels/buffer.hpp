// Uninitialised memory for scratch, aligned to a cache line and freed with its scope.
#pragma once
#include <cstddef>
#include <memory>
#include <new>
#include <type_traits>

namespace ldo::LDO_ISA {

template <class T>
class Buffer {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  explicit Buffer(size_t size)
      : data_(static_cast<T*>(::operator new(size * sizeof(T) + 1, kAlignment))), size_(size) {}

  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  size_t size() const { return size_; }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Free {
    void operator()(T* p) const { ::operator delete(p, kAlignment); }
  };
  std::unique_ptr<T[], Free> data_;
  size_t size_;
};

}  // namespace ldo::LDO_ISA
