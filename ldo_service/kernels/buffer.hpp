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
  Buffer() = default;
  explicit Buffer(size_t size) { resize(size); }

  // Room for `size` items, whose values are then undefined. Only growth asks for memory: it is
  // worth keeping, because the first touch of every fresh page costs more than its use.
  void resize(size_t size) {
    size_ = size;
    if (size <= capacity_) return;
    data_.reset();
    capacity_ = capacity_ == 0 ? size : size + size / 4;
    data_.reset(static_cast<T*>(::operator new(capacity_ * sizeof(T), kAlignment)));
  }

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
  size_t size_ = 0, capacity_ = 0;
};

}  // namespace ldo::LDO_ISA
