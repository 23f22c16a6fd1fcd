// Jobs that may run side by side.
//
// The caller cuts the work into jobs without looking at the number of threads, and every job
// writes its own part of the output: then the result has the same bits for any number of threads.
#pragma once
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <thread>

namespace ldo::LDO_ISA {

class Workers {  // threads that are joined on every way out of the scope
 public:
  explicit Workers(int capacity) : threads_(new std::thread[capacity]) {}
  Workers(const Workers&) = delete;
  Workers& operator=(const Workers&) = delete;
  ~Workers() {
    for (int i = 0; i < started_; ++i) threads_[i].join();
  }
  template <class F>
  void start(const F& work) {
    threads_[started_] = std::thread([&work] { work(); });
    ++started_;
  }

 private:
  std::unique_ptr<std::thread[]> threads_;
  int started_ = 0;
};

// Calls f(job) for every job in [0, jobs) on up to `threads` threads, this one included; returns
// when all are done. f must not throw.
template <class F>
void parallel_for(int64_t jobs, int threads, const F& f) {
  std::atomic<int64_t> next{0};
  const auto work = [&] {
    for (int64_t job; (job = next.fetch_add(1, std::memory_order_relaxed)) < jobs;) f(job);
  };
  const int helpers = static_cast<int>(std::min<int64_t>(threads, jobs)) - 1;
  Workers workers(std::max(helpers, 0));
  for (int i = 0; i < helpers; ++i) workers.start(work);
  work();
}

}  // namespace ldo::LDO_ISA
