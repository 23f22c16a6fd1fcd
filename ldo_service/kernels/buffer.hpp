// Uninitialized scratch memory, aligned to a cache line and freed with its scope.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ldo::LDO_ISA {

constexpr size_t kCacheLine = 64, kHugePage = size_t{1} << 21;

// Allocate memory. If it is kept, it uses huge pages where the system has them. Reads in random
// order then cause cache misses alone, without additional page-table lookups.
inline void* allocate(size_t bytes, bool kept) {
  const bool huge = kept && bytes >= kHugePage;
  const size_t alignment = huge ? kHugePage : kCacheLine;
  const size_t size = (bytes + alignment - 1) / alignment * alignment;
  void* memory = std::aligned_alloc(alignment, size);
  if (memory == nullptr && size > 0) throw std::bad_alloc();
#if defined(__linux__)
  if (huge) madvise(memory, size, MADV_HUGEPAGE);  // The call is advice and may fail.
#endif
  return memory;
}

// Growing array of uninitialized items.
template <class T>
class Buffer {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  Buffer() = default;
  explicit Buffer(size_t size) { resize(size); }

  // Declare that the buffer will be used repeatedly. Call this before the first `resize`.
  void keep() { kept_ = true; }

  // Make room for `size` items, whose values are then undefined. Memory is allocated only when the
  // buffer grows and is kept when it shrinks, because the first access to a new page takes longer
  // than the use of the page.
  void resize(size_t size) {
    size_ = size;
    if (size <= capacity_) return;
    data_.reset();
    capacity_ = capacity_ == 0 ? size : size + size / 4;
    data_.reset(static_cast<T*>(allocate(capacity_ * sizeof(T), kept_)));
  }

  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  size_t size() const { return size_; }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }

 private:
  struct Free {
    void operator()(T* p) const { std::free(p); }
  };
  std::unique_ptr<T[], Free> data_;
  size_t size_ = 0, capacity_ = 0;
  bool kept_ = false;
};

}  // namespace ldo::LDO_ISA
