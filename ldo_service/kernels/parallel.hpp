// Jobs that may run side by side.
//
// Every job writes its own part of the output. Where sums of floats are taken, the work is cut into
// jobs without looking at the number of threads: then the result has the same bits for any number.
#pragma once
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace ldo::LDO_ISA {

// The threads of one call, this one included: started once, joined on every way out of the scope.
class Team {
 public:
  explicit Team(int threads) {
    helpers_.reserve(threads - 1);
    try {
      for (int i = 1; i < threads; ++i) helpers_.emplace_back([this] { help(); });
    } catch (const std::system_error&) {  // no more threads to be had: those that are do the work
    }
  }
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;
  ~Team() {
    open_round(nullptr, nullptr, 0);
    for (std::thread& helper : helpers_) helper.join();
  }

  int size() const { return static_cast<int>(helpers_.size()) + 1; }

  // Calls f(job) for every job in [0, jobs); returns when all are done. f must not throw.
  template <class F>
  void each(int64_t jobs, const F& f) {
    if (jobs <= 1 || helpers_.empty()) {
      for (int64_t job = 0; job < jobs; ++job) f(job);
      return;
    }
    const auto call = [](const void* function, int64_t job) {
      (*static_cast<const F*>(function))(job);
    };
    open_round(call, &f, jobs);
    work();
    close_round();
  }

 private:
  using Call = void (*)(const void* function, int64_t job);

  void open_round(Call call, const void* function, int64_t jobs) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      call_ = call;
      function_ = function;
      jobs_ = jobs;
      next_ = 0;
      ++round_;
      is_open_ = true;
    }
    opened_.notify_all();
  }

  // Waits for the helpers that have begun; one that wakes later finds the round closed.
  void close_round() {
    yield_while([this] { return working_ > 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    is_open_ = false;
    left_.wait(lock, [this] { return working_ == 0; });
  }

  void work() {
    for (int64_t job; (job = next_.fetch_add(1, std::memory_order_relaxed)) < jobs_;)
      call_(function_, job);
  }

  void help() {
    for (int64_t seen = 0;;) {
      yield_while([&] { return round_ == seen; });
      std::unique_lock<std::mutex> lock(mutex_);
      opened_.wait(lock, [&] { return is_open_ && round_ != seen; });
      seen = round_;
      if (call_ == nullptr) return;
      ++working_;
      lock.unlock();
      work();
      lock.lock();
      if (--working_ == 0) left_.notify_one();
    }
  }

  // The next round is mostly a few microseconds away, and sleeping costs more.
  template <class Condition>
  static void yield_while(Condition condition) {
    for (int i = 0; i < 64 && condition(); ++i) std::this_thread::yield();
  }

  std::vector<std::thread> helpers_;
  std::mutex mutex_;
  std::condition_variable opened_, left_;
  Call call_ = nullptr;  // null: the last round
  const void* function_ = nullptr;
  int64_t jobs_ = 0;
  std::atomic<int64_t> next_{0}, round_{0};
  std::atomic<int> working_{0};
  bool is_open_ = false;
};

}  // namespace ldo::LDO_ISA
